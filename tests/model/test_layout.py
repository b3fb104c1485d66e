# SPDX-License-Identifier: GPL-3.0-or-later
"""Channels by name: split and joined, taken away, and refused where they do not fit."""

import pytest
import torch

from timesplat.model.layout import Layout

LAYOUT = Layout({"xyz": 3, "t": 1, "rgb": 3})


def test_split_and_joined_again():
    x = torch.arange(14.0).reshape(2, 7)
    groups = LAYOUT.split(x)
    assert [g.shape for g in groups.values()] == [(2, 3), (2,), (2, 3)]
    assert groups["t"].tolist() == [3, 10] and groups["rgb"].tolist() == [[4, 5, 6], [11, 12, 13]]
    assert torch.equal(LAYOUT.join(**groups), x)


def test_slices_of_one_and_of_neighbours():
    assert LAYOUT.width == 7
    assert LAYOUT.slice("rgb") == slice(4, 7) and LAYOUT.slice("xyz", "t") == slice(0, 4)


def test_one_group_fewer():
    timeless = LAYOUT.without("t")
    assert timeless == Layout({"xyz": 3, "rgb": 3}) and "t" in LAYOUT and "t" not in timeless


def test_what_does_not_fit_is_refused():
    xyz, t, rgb = torch.zeros(2, 3), torch.zeros(2), torch.zeros(2, 3)
    with pytest.raises(ValueError, match="'t'"):
        LAYOUT.join(xyz=xyz, rgb=rgb)
    with pytest.raises(ValueError, match="'alpha'"):
        LAYOUT.join(xyz=xyz, t=t, rgb=rgb, alpha=t)
    with pytest.raises(ValueError, match="rgb has 2 channels"):
        LAYOUT.join(xyz=xyz, t=t, rgb=rgb[:, :2])
