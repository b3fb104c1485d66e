# SPDX-License-Identifier: GPL-3.0-or-later
"""The visual hull: within the silhouettes and in the mean colour; and the empty picture."""

import torch

from timesplat.model.baselines.visual_hull import visual_hull, white


def test_the_hull_is_within_the_silhouettes_in_one_colour(spheres):
    views = spheres(list(range(0, 24, 2)), size=48)
    g = visual_hull(views)
    assert len(g) > 500 and (g.rgb == g.rgb[0]).all() and (g.velocity == 0).all()
    assert set(g.t.tolist()) == set(views.time.tolist())
    view, now = views[:1], g[g.t == views.time[0]]
    local = (now.xyz - view.c2w[0, :3, 3]) @ view.c2w[0, :3, :3]
    f, c = view.intrinsics[0, :2], view.intrinsics[0, 2:]
    pixel = (local[:, :2] / local[:, 2:] * f + c).floor().long()
    assert (view.alpha[0][pixel[:, 1], pixel[:, 0]] > 0.5).all()


def test_white_is_nothing(spheres):
    g = white(spheres([0], size=16))
    assert len(g) == 0 and g.xyz.shape == (0, 3) and g.rotation.shape == (0, 4) and torch.is_tensor(g.opacity)
