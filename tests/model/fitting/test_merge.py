# SPDX-License-Identifier: GPL-3.0-or-later
"""Merging: moments are kept, what stands still is merged over the clip; contributions are the blending weights."""

from dataclasses import replace

import pytest
import torch

from timesplat.model.fitting.fit_views import squared_error
from timesplat.model.fitting.merge import MOMENTS, contribution, merge_gaussians
from timesplat.model.gaussians import Gaussians4D
from timesplat.model.geometry.lift import lift
from timesplat.model.rasterize import render


@pytest.fixture(scope="module")
def views(spheres):
    return spheres(list(range(24)), size=48)


def test_moments_are_kept(views):
    g = lift(views)
    few = merge_gaussians(g, 500)
    assert 350 < len(few) < 650 and merge_gaussians(g, len(g)) is g
    assert squared_error(few, views) < 0.02
    pair = g[[0, 0]]
    same = merge_gaussians(pair, 1)
    torch.testing.assert_close(same.covariance3(), pair.covariance3()[:1], atol=1e-7, rtol=1e-3)
    for k in ("xyz", "t", "velocity", "sigma_t", "rgb"):
        torch.testing.assert_close(getattr(same, k), getattr(pair, k)[:1], atol=1e-5, rtol=1e-4)


def row(n: int, **changes) -> Gaussians4D:
    """n Gaussians at one place, at times spread over the clip."""
    one = torch.ones(n)
    g = Gaussians4D(
        xyz=torch.zeros(n, 3) + 0.3,
        t=torch.linspace(-0.95, 0.95, n),
        velocity=torch.zeros(n, 3),
        sigma_t=0.05 * one,
        scale=0.02 * torch.ones(n, 3),
        rotation=torch.tensor([1.0, 0, 0, 0]).expand(n, 4),
        rgb=torch.rand(n, 3, generator=torch.Generator().manual_seed(0)),
        opacity=0.5 * one,
    )
    return replace(g, **changes)


def test_what_stands_still_is_one_for_the_whole_clip_and_what_moves_is_not():
    g = row(24)
    one = merge_gaussians(g, 1)
    assert len(one) == 1
    # the moments over time, by hand
    t = g.t - g.t.mean()
    torch.testing.assert_close(one.sigma_t, (0.05**2 + t.square().mean()).sqrt()[None])
    torch.testing.assert_close(one.rgb, g.rgb.mean(0, keepdim=True))
    moving = merge_gaussians(row(24, velocity=torch.tensor([2.0, 0, 0]).expand(24, 3)), 1)
    assert len(moving) == MOMENTS


def test_who_is_seen_more_decides_the_means():
    g = row(2, t=torch.zeros(2), opacity=torch.tensor([0.6, 0.2]))
    few = merge_gaussians(g, 1)
    torch.testing.assert_close(few.rgb[0], 0.75 * g.rgb[0] + 0.25 * g.rgb[1])


def test_contributions_add_up_to_the_pictures(views):
    g = lift(views[::4])
    seen = views[1::8]
    w = contribution(g, seen)
    height, width = seen.size
    _, alpha = render(g, seen.c2w, seen.intrinsics, seen.time, width, height)
    torch.testing.assert_close(w.sum(), alpha.sum(), rtol=1e-4, atol=1e-2)
    assert (w >= 0).all() and not w.requires_grad
    # a Gaussian behind an opaque wall, or dead by then, contributes nothing
    wall = g[:1].map(torch.clone)
    wall.xyz, wall.velocity, wall.opacity = torch.zeros(1, 3), torch.zeros(1, 3), torch.ones(1)
    wall.scale, wall.sigma_t = torch.full((1, 3), 0.8), torch.full((1,), 1e6)
    front = seen.c2w[:1, :3, 2]
    behind = replace(wall, xyz=2 * front, scale=0.01 * wall.scale)
    early = replace(behind, xyz=-0.5 * front, t=torch.tensor([-50.0]), sigma_t=torch.tensor([0.1]))
    w = contribution(Gaussians4D.cat([wall, behind, early]), seen[:1])
    assert w[0] > 100 and w[1] < 0.01 * w[0] and w[2] == 0
