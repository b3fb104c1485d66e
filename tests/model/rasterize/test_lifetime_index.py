# SPDX-License-Identifier: GPL-3.0-or-later
"""The index of lifetimes: nothing that is drawn is missing, and the pictures are the same."""

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from timesplat.model.gaussians import Gaussians4D
from timesplat.model.geometry.lift import lift
from timesplat.model.rasterize import render
from timesplat.model.rasterize.lifetime_index import LifetimeIndex


def cloud(n: int, seed: int) -> Gaussians4D:
    gen = torch.Generator().manual_seed(seed)

    def r(*shape):
        return torch.rand(*shape, generator=gen)

    turn = torch.nn.functional.normalize(r(n, 4) - 0.5, dim=-1)
    return Gaussians4D(
        r(n, 3) - 0.5, 3 * r(n) - 1.5, r(n, 3) - 0.5, 10 ** (3 * r(n) - 2.5), 0.01 + 0.1 * r(n, 3), turn, r(n, 3), r(n)
    )


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 2**31), st.floats(-1, 1, width=32), st.sampled_from([1, 7, 64]))
def test_whoever_is_drawn_is_in_the_list(seed, t, bins):
    g = cloud(300, seed)
    index = LifetimeIndex(g, bins)
    p = g.marginal(torch.tensor(t))
    drawn = ((p >= 0.05) & (g.opacity * p >= 0.05)).nonzero()[:, 0]
    assert set(drawn.tolist()) <= set(index.candidates(t).tolist())
    assert (index.candidates(t).diff() > 0).all() and len(index) == 300


def test_short_lives_are_in_few_lists_and_pictures_are_the_same(spheres):
    views = spheres(list(range(0, 24, 2)), size=48)
    g = lift(views)
    index = LifetimeIndex(g)
    alive = torch.tensor([len(index.candidates(float(t))) / len(g) for t in views.time])
    assert alive.max() < 0.6 and alive.min() > 0.01
    cameras = views.c2w, views.intrinsics, views.time, 48, 48
    for one, same in zip(*(render(scene, *cameras, inference=True) for scene in (index, g)), strict=True):
        torch.testing.assert_close(one, same, rtol=0, atol=1e-4)
    for beyond, end in ((-7.0, -1.0), (7.0, 1.0)):
        assert torch.equal(index.candidates(beyond), index.candidates(end))
