# SPDX-License-Identifier: GPL-3.0-or-later
"""The sweep against exact depth and motion, and its independence of what only a renderer knows."""

import pytest
import torch

from timesplat.model.geometry.plane_sweep import centre_path, expected_lifetime, sweep_depth, sweep_geometry


def errors(views):
    """-> error of the swept depth, and what the best constant depth would be off by, both on the object."""
    depth = sweep_depth(views)[0]
    on = depth > 0
    assert torch.equal(on, views.alpha > 0.35)
    return (depth - views.depth)[on].abs(), (views.depth[on] - views.depth[on].mean()).abs()


def around(n):
    return [(40 * i, 20 * (-1) ** i) for i in range(n)]


def moved(views, path):
    """The views as they are of the same scene with its middle led along path (V,3): cameras moved instead."""
    views.c2w = views.c2w.clone()
    views.c2w[:, :3, 3] += path
    return views


def test_depth_is_near_the_truth_and_knows_how_near(spheres):
    views = spheres(list(range(24)), around(24))
    depth, spread, certainty = sweep_depth(views)
    on = depth > 0
    error, guess = errors(views)
    assert error.median() < 0.5 * guess.median()
    sure = spread[on] < spread[on].median()
    assert error[sure].mean() < error[~sure].mean()
    assert ((certainty >= 0) & (certainty <= 1)).all()


@pytest.mark.parametrize("step", [2 / 23, 2.0])
def test_views_of_one_moment_use_each_other_fully(spheres, step):
    views = spheres([12] * 16, around(16))
    views.time, views.frame_step = torch.zeros(16), step
    error, guess = errors(views)
    assert error.median() < 0.5 * guess.median()
    assert torch.isfinite(sweep_geometry(views).gaussians.sigma_t).all()


def test_motion_of_the_whole_object_is_taken_out(spheres):
    frames = list(range(24))
    path = torch.tensor([[0.01 * (f - 11.5), 0.006 * (f - 11.5), 0.0] for f in frames])
    still, moving = spheres(frames, around(24)), moved(spheres(frames, around(24)), path)
    found = centre_path(moving) - centre_path(still)
    torch.testing.assert_close(found - found.mean(0), path, rtol=0, atol=0.04)
    assert errors(moving)[0].mean() < 1.3 * errors(still)[0].mean()


def test_one_view_alone(spheres):
    geometry = sweep_geometry(spheres([5]))
    assert len(geometry.gaussians) > 0
    for x in (geometry.gaussians.xyz, geometry.gaussians.sigma_t, geometry.features.values, geometry.max_shift):
        assert torch.isfinite(x).all()


def test_it_uses_pictures_alone(spheres):
    views, blind = spheres([0, 1, 2, 3]), spheres([0, 1, 2, 3])
    blind.depth = blind.flow = None
    a, b = sweep_geometry(views), sweep_geometry(blind)
    torch.testing.assert_close(a.gaussians.xyz, b.gaussians.xyz, rtol=0, atol=0)
    assert torch.isfinite(a.gaussians.xyz).all() and torch.isfinite(a.features.values).all()


def test_lifetime_in_alternating_views_is_half_their_period(spheres):
    torch.testing.assert_close(expected_lifetime(spheres(list(range(24)))), torch.full((24,), 2.0))
