"""The lift on a scene known by hand: places, velocities, lifetimes, and pictures."""

import numpy as np
import pytest
import torch

from timesplat.model import lift as lift_module
from timesplat.model.evaluate import draw
from timesplat.model.follow import EXTENT, GRID, Points, constraints, scene_flow
from timesplat.model.lift import lift, lift_geometry, tangent_frame
from timesplat.model.metrics import psnr
from timesplat.model.views import rays

FRAMES = list(range(24))


@pytest.fixture(scope="module")
def views(spheres):
    return spheres(FRAMES)


def own_piece(geometry, views):
    """For each pixel with Gaussians: the one of its own time -> pixel index, Gaussians."""
    view_time = views.time[:, None, None].expand_as(views.alpha).flatten()[geometry.owner]
    away = (geometry.gaussians.t - view_time).abs()
    best = {}
    for k, (pixel, a) in enumerate(zip(geometry.owner.tolist(), away.tolist(), strict=True)):
        if pixel not in best or a < best[pixel][0]:
            best[pixel] = (a, k)
    pixels = torch.tensor(list(best))
    return pixels, geometry.gaussians[torch.tensor([k for _, k in best.values()])]


def test_places_at_the_views_own_time_are_on_the_surface(views, monkeypatch):
    monkeypatch.setattr(lift_module, "INSET", 0.0)
    pixels, g = own_piece(lift_geometry(views), views)
    here = g.position(views.time[:, None, None].expand_as(views.alpha).flatten()[pixels])
    origin, direction = rays(views.c2w, views.intrinsics, *views.size)
    forward = views.c2w[:, None, None, :3, 2]
    z = torch.where(torch.isfinite(views.depth), views.depth, 0.0)
    truth = origin + direction * (z / (direction * forward).sum(-1))[..., None]
    error = (here - truth.reshape(-1, 3)[pixels]).norm(dim=-1)
    assert len(pixels) == int(torch.isfinite(views.depth).sum())
    assert error.max() < 0.06 and error.median() < 0.005  # a pixel is 0.054 here; pieces may be half of it off


def test_velocities_match_the_true_motion_in_all_three_directions(spheres, views):
    """Motion vectors give two of the three components; views from other sides give the third."""
    pixels, g = own_piece(lift_geometry(views), views)
    frame = pixels.numpy() // (48 * 48)
    at = g.position(views.time[pixels // (48 * 48)]).numpy()
    error = np.linalg.norm(g.velocity.numpy() * views.frame_step - spheres.truth(at, frame), axis=-1)
    assert np.median(error) < 0.004  # speeds are 0.022 to 0.025 a frame
    assert np.percentile(error, 90) < 0.02


def test_scene_flow_is_exact_where_two_sides_see_one_motion(spheres):
    """Two perpendicular views of one rigid translation: the least squares have one answer."""
    views = spheres([5, 5], [(0, 0), (90, 0)])
    torch.manual_seed(0)
    n, motion = 200, torch.tensor([0.02, -0.01, 0.03])
    place, view = torch.rand(n, 3) * 0.05 + 0.2, torch.arange(n) % 2
    w2c = torch.linalg.inv(views.c2w)[view]

    def project(p):
        local = (w2c[:, :3, :3] @ p[..., None])[..., 0] + w2c[:, :3, 3]
        return local[:, :2] / local[:, 2:], local[:, 2]

    ray, depth = project(place)
    f = views.intrinsics[0, 0]
    to_next, to_previous = ((project(place + k * motion)[0] - ray) * f for k in (1, -1))
    points = Points(view, place, place, depth / f, to_next, to_previous, depth, ray)
    field = scene_flow(views, points, *constraints(views, points), 23)
    cell = ((place.mean(0) / EXTENT + 1) * GRID / 2).long()
    torch.testing.assert_close(field[5][tuple(cell)], motion, atol=5e-4, rtol=0)


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
    assert score > 24 and score > frozen_score + 0.5


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
    assert len(g) >= 1 and all(torch.isfinite(getattr(g, k)).all() for k in ("xyz", "scale", "rotation", "sigma_t"))
