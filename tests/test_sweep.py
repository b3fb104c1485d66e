"""The sweep against exact depth, and its independence of what only a renderer knows."""

import torch

from timesplat.model.sweep import relief, sweep_depth, sweep_geometry


def test_depth_is_near_the_truth_and_knows_how_near(spheres):
    views = spheres(list(range(24)), [(40 * i, 20 * (-1) ** i) for i in range(24)])
    depth, spread, certainty = sweep_depth(views)
    on = depth > 0
    assert torch.equal(on, views.alpha > 0.35)
    error = (depth - views.depth)[on].abs()
    guess = (views.depth[on] - views.depth[on].mean()).abs()  # what the best constant depth would be off by
    assert error.median() < 0.4 * guess.median()
    sure = spread[on] < spread[on].median()
    assert error[sure].mean() < error[~sure].mean()
    assert ((certainty >= 0) & (certainty <= 1)).all()


def test_it_uses_pictures_alone(spheres):
    views, blind = spheres([0, 1, 2, 3]), spheres([0, 1, 2, 3])
    blind.depth = blind.flow = None
    a, b = sweep_geometry(views), sweep_geometry(blind)
    torch.testing.assert_close(a.gaussians.xyz, b.gaussians.xyz, rtol=0, atol=0)
    assert torch.isfinite(a.gaussians.xyz).all() and torch.isfinite(a.features).all()


def test_relief_of_alternating_views_is_half_their_period(spheres):
    torch.testing.assert_close(relief(spheres(list(range(24)))), torch.full((24,), 2.0))
