# SPDX-License-Identifier: GPL-3.0-or-later
"""4DGS: it learns from random points, the same on every run by steps, and ends in time by seconds."""

import pytest
import torch

from timesplat.model.baselines.four_dgs import POINTS, four_dgs
from timesplat.model.baselines.visual_hull import white
from timesplat.model.methods import ReconstructOptions
from timesplat.model.reconstruct import reconstruct_views


@pytest.fixture(scope="module")
def moving(spheres):
    """Input views of the moving spheres, and held-out ones."""
    frames = list(range(24))
    return spheres(frames, size=32), spheres(frames[3::6], [(45, 20), (200, -10), (120, 30), (300, 10)], size=32)


def test_4dgs_learns_from_random_points(moving, quality):
    inputs, held_out = moving
    with torch.inference_mode():
        empty, start = quality(white(inputs), held_out), four_dgs(inputs, steps=0)
        g = four_dgs(inputs, steps=120)
    assert len(start) == POINTS and quality(start, held_out) < empty + 0.1
    assert quality(g, inputs) > empty + 8 and quality(g, held_out) > empty + 4
    assert not g.xyz.requires_grad


def test_a_number_of_steps_gives_the_same_on_every_run_and_seconds_end(moving, steady_clock):
    views = moving[0]
    a, b = four_dgs(views, steps=6), four_dgs(views, steps=6)
    torch.testing.assert_close(a.xyz, b.xyz, rtol=0, atol=0)
    torch.testing.assert_close(a.opacity, b.opacity, rtol=0, atol=0)
    told = []
    options = ReconstructOptions(seconds=0.3)
    reconstruct_views(views, "4dgs", options, lambda fraction, text: told.append((fraction, text)))
    assert told[0] == (0, "4dgs: planned 27 steps of 2 views in 0.3 s")
    assert told == sorted(told, key=lambda t: t[0]) and told[-1] == (1, "4dgs, step 26 of 26")
