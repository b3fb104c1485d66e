"""The lift on a scene known by hand: places, velocities, lifetimes, and pictures."""

import numpy as np
import pytest
import torch

from timesplat.model.evaluate import draw
from timesplat.model.lift import lift, lift_geometry, tangent_frame
from timesplat.model.metrics import psnr

FRAMES = list(range(24))


@pytest.fixture(scope="module")
def views(spheres):
    return spheres(FRAMES)


def test_places_are_on_the_surface_at_the_views_own_time(spheres, views):
    geometry = lift_geometry(views)
    g = geometry.gaussians
    here = g.position(views.time[:, None, None])[geometry.valid]
    z = torch.where(torch.isfinite(views.depth), views.depth, 0.0)
    from timesplat.model.views import rays

    origin, direction = rays(views.c2w, views.intrinsics, *views.size)
    forward = views.c2w[:, None, None, :3, 2]
    truth = origin + direction * (z / (direction * forward).sum(-1))[..., None]
    torch.testing.assert_close(here, truth[geometry.valid], atol=1e-4, rtol=0)


def test_velocities_match_the_true_motion_in_all_three_directions(spheres, views):
    """Motion vectors give two of the three components; the third is found by agreement between views."""
    geometry = lift_geometry(views)
    g, valid = geometry.gaussians, geometry.valid
    at = g.position(views.time[:, None, None])[valid].numpy()
    frame = np.repeat(FRAMES, valid.flatten(1).sum(1).numpy())
    error = np.linalg.norm(g.velocity[valid].numpy() * views.frame_step - spheres.truth(at, frame), axis=-1)
    assert np.median(error) < 0.0055  # a tenth of a pixel (0.054) a frame at this size; speeds: 0.022 to 0.025
    assert np.percentile(error, 90) < 0.02


def test_a_side_seen_often_lives_shorter(spheres):
    often = lift(spheres(FRAMES)).sigma_t.median()
    seldom = lift(spheres(FRAMES[::3], [(90 * i, 0) for i in range(8)])).sigma_t.median()
    assert seldom > 1.5 * often


def test_novel_views_beat_a_lift_that_stands_still(spheres, views):
    rng = np.random.default_rng(0)
    targets = spheres(FRAMES, [(rng.uniform(0, 360), rng.uniform(-30, 60)) for _ in FRAMES])
    still = spheres(FRAMES)
    still.flow = torch.zeros_like(still.flow)
    g, frozen = lift(views), lift(still)
    frozen.velocity = torch.zeros_like(frozen.velocity)
    score, frozen_score = (float(psnr(draw(x, targets)[0], targets.over()).mean()) for x in (g, frozen))
    assert score > 24 and score > frozen_score + 1


def test_tangent_frame_of_a_slanted_plane():
    """A plane at 60 degrees to the image: the footprint is twice as long down the slope, and the axes are a
    right-handed rotation whose third axis is the plane's normal."""
    du, dv = torch.tensor([[0.01, 0, 0]]), torch.tensor([[0, 0.01, 0.01 * 3**0.5]])
    scale, axes = tangent_frame(du, dv, torch.tensor([[0.0, 0, 2]]), torch.tensor([0.01]))
    assert float(scale[0, 0] / scale[0, 1]) == pytest.approx(2, rel=1e-5)
    normal = torch.tensor([0, 3**0.5 / 2, -0.5])
    torch.testing.assert_close(axes[0, :, 2], normal, atol=1e-5, rtol=0)
    torch.testing.assert_close(axes[0] @ axes[0].T, torch.eye(3), atol=1e-5, rtol=0)
    assert float(torch.linalg.det(axes)[0]) == pytest.approx(1, abs=1e-5)


def test_a_lone_pixel_and_an_empty_view_are_finite(spheres):
    views = spheres([0, 1])
    keep = torch.zeros_like(views.alpha)
    row, column = (views.alpha[0] > 0).nonzero()[0].tolist()
    keep[0, row, column] = 1
    views.alpha = keep
    g = lift(views)
    assert len(g) == 1 and all(torch.isfinite(getattr(g, k)).all() for k in ("xyz", "scale", "rotation", "sigma_t"))
