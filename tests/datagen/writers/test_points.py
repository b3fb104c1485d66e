# SPDX-License-Identifier: GPL-3.0-or-later
"""Points to start from: on the object, in its colours."""

from dataclasses import replace

import numpy as np

from timesplat.datagen.writers.points import MOST, start_points

from ..readers.worlds import BALLS, MOTION


def test_they_are_on_the_balls_in_their_colours(seq):
    points, colours = start_points(seq)
    assert 100 < len(points) <= MOST and colours.dtype == np.uint8
    middles = np.concatenate([BALLS + t * MOTION for t in (0, 0.5, 1)])
    away = np.linalg.norm(points[:, None] - middles, axis=-1).min(1)
    assert np.median(away) < 0.45
    red = np.linalg.norm(points - BALLS[0], axis=1) < 0.15
    assert red.any() and (colours[red, 0] > colours[red, 2]).mean() > 0.6
    again = start_points(seq)
    assert (again[0] == points).all() and (again[1] == colours).all()


def test_without_silhouettes_they_fill_the_box(seq):
    whole = replace(seq, picture=lambda v: np.full((24, 24, 4), 255, np.uint8))
    points, _ = start_points(whole)
    assert len(points) > 100 and np.abs(points).max() < 20
