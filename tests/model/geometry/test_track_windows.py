# SPDX-License-Identifier: GPL-3.0-or-later
"""How long points are there."""

import numpy as np

from timesplat.model.geometry.track_windows import fill_gaps


def test_points_go_on_where_no_other_is_near():
    """Two points in one place, of which one is sure before, the other after; and one far from them."""
    position = np.zeros((3, 10, 3), np.float32)
    position[2] = 1
    sure, most = np.array([[2, 4], [7, 8], [5, 5]]), np.array([[0, 9], [3, 9], [4, 6]])
    fill_gaps(position, sure, most, np.float32(0.1))
    assert sure.tolist() == [[0, 5], [6, 9], [4, 6]]
