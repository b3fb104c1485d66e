# SPDX-License-Identifier: GPL-3.0-or-later
"""The lift on a scene known by hand: places, velocities, footprints, and pictures."""

import numpy as np
import pytest
import torch

from timesplat.datagen.rigs import spherical
from timesplat.datagen.sequence import opengl_to_opencv
from timesplat.evaluation.image_quality import psnr
from timesplat.evaluation.scoring import draw
from timesplat.model.geometry.lift import LiftSettings, lift, lift_geometry, tangent_frame
from timesplat.model.rotations import rotation_matrix
from timesplat.model.views import Views, load_views, rays

FRAMES = list(range(24))


@pytest.fixture(scope="module")
def views(spheres):
    return spheres(FRAMES)


def own_piece(geometry, views):
    """For each pixel with Gaussians: the one of its own time -> pixel index, Gaussians."""
    view_time = views.time[:, None, None].expand_as(views.alpha).flatten()[geometry.pixel_index]
    away = (geometry.gaussians.t - view_time).abs()
    best = {}
    for k, (pixel, a) in enumerate(zip(geometry.pixel_index.tolist(), away.tolist(), strict=True)):
        if pixel not in best or a < best[pixel][0]:
            best[pixel] = (a, k)
    pixels = torch.tensor(list(best))
    return pixels, geometry.gaussians[torch.tensor([k for _, k in best.values()])]


def test_places_at_the_views_own_time_are_on_the_surface(views):
    pixels, g = own_piece(lift_geometry(views, LiftSettings(inset=0.0)), views)
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


@pytest.fixture(scope="module")
def dancer(tmp_path_factory):
    """A procedural object, turning as it dances, rendered at 64x64 by four cameras in turn: its Views, and
    `track(points, frame)`: (n,3) points near the surface at a frame -> (24,n,3) true places of the closest surface
    points at every frame, normalised."""
    bpy = pytest.importorskip("bpy")
    from mathutils import Vector
    from mathutils.bvhtree import BVHTree

    from timesplat.datagen import rigs
    from timesplat.datagen.capture import Subject, capture
    from timesplat.datagen.render_setup import CaptureSettings
    from timesplat.datagen.scene.measure import normalisation
    from timesplat.datagen.scene.open import empty_session
    from timesplat.datagen.zoo.build import build_object

    empty_session()
    build_object(900002)
    frames = list(range(1, 25))
    norm, _ = normalisation(frames)
    out = tmp_path_factory.mktemp("dancer") / "zoo"
    shots = rigs.alternating(list(range(24)))
    seq = capture(shots, out, Subject(frames, norm), CaptureSettings(size=64, samples=4))
    mesh = bpy.data.meshes["zoo_900002"]
    mesh.calc_loop_triangles()
    triangles = np.array([t.vertices for t in mesh.loop_triangles])
    keys = mesh.shape_keys.key_blocks
    posed = np.empty((24, len(mesh.vertices) * 3), np.float32)
    for key, row in zip(keys, posed, strict=True):
        key.data.foreach_get("co", row)
    posed = (posed.reshape(24, -1, 3) - np.float32(norm.translation)) / norm.scale

    def track(points, frame):
        tree = BVHTree.FromPolygons([Vector(p) for p in posed[frame]], triangles.tolist())
        found = [tree.find_nearest(Vector(p)) for p in points]
        corners = triangles[[f[2] for f in found]]
        near = np.array([f[0] for f in found])
        a, b, c = np.moveaxis(posed[frame][corners], 1, 0)
        weights = np.stack([np.linalg.pinv(np.stack(t, 1)) @ p for *t, p in zip(b - a, c - a, near - a, strict=True)])
        weights = np.concatenate([1 - weights.sum(1, keepdims=True), weights], 1)
        return np.einsum("nc,fncx->fnx", weights, posed[:, corners])

    return load_views(seq, range(24), has_depth=True), track


def test_velocities_and_later_places_are_those_of_the_mesh(dancer):
    """Blender's renders in, Blender's mesh as truth: errors in pixels, per frame, of what moves by 1 to 5."""
    views, track = dancer
    geometry, step = lift_geometry(views, LiftSettings(inset=0.0)), views.frame_step
    pixels, g = own_piece(geometry, views)
    pixels, g = pixels[::5], g[::5]
    view = pixels // 64**2
    size = (views.depth.flatten()[pixels] / views.intrinsics[0, 0]).numpy()
    at, moved, velocity, later = (np.zeros(len(pixels)) for _ in range(4))
    for f in range(1, 23):
        here = (view == f).nonzero()[:, 0]
        mine = g[here]
        place = mine.position(views.time[view[here]]).numpy()
        truth = track(place, f)
        # A piece before or after the view's time has that side's velocity, one in the middle the mean.
        side = ((mine.t - views.time[f]) / step).numpy()[:, None]
        past, next_ = truth[f] - truth[f - 1], truth[f + 1] - truth[f]
        true_velocity = np.where(side > 0.1, next_, np.where(side < -0.1, past, (past + next_) / 2))
        # Of each pixel the piece that is strongest one frame later.
        after, owned = views.time[f] + step, torch.isin(geometry.pixel_index, pixels[here])
        pieces, of = geometry.gaussians[owned], geometry.pixel_index[owned]
        order = torch.argsort(pieces.marginal(after), stable=True)
        last = {int(of[k]): k for k in order}
        best = pieces[torch.stack([last[int(p)] for p in pixels[here]])]
        alive = (best.marginal(after) > 0.3).numpy()
        error = np.linalg.norm(best.position(after).numpy() - truth[f + 1], axis=-1)
        for values, x in (
            (at, np.linalg.norm(place - truth[f], axis=-1)),
            (moved, np.linalg.norm(true_velocity, axis=-1)),
            (velocity, np.linalg.norm(mine.velocity.numpy() * step - true_velocity, axis=-1)),
            (later, np.where(alive, error, np.nan)),
        ):
            values[here] = x / size[here]
    inner = ((view > 0) & (view < 23)).numpy()
    assert np.isfinite(later[inner]).mean() > 0.5
    for x, median, most in ((at, 0.08, 0.3), (velocity, 0.25, 1.8), (later, 0.3, 1.3)):
        found = np.nanpercentile(x[inner], [50, 95])
        assert found[0] < median and found[1] < most
    assert np.median(moved[inner]) > 1


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


def test_footprints_on_a_slanted_square():
    """A square in the plane y = 0, seen at 55 degrees: every Gaussian lies in it, as long as its pixel's ray is
    slanted, and as wide as the pixel."""
    c2w = torch.tensor(opengl_to_opencv(spherical(55, 0)), dtype=torch.float32)[None]
    K = torch.tensor([[70.0, 70, 32, 32]])
    origin, direction = rays(c2w, K, 64, 64)
    distance = -origin[..., 1] / direction[..., 1]
    hit = (origin + distance[..., None] * direction)[..., [0, 2]].abs().amax(-1) < 0.5
    depth = torch.where(hit, distance * (direction * c2w[:, None, None, :3, 2]).sum(-1), torch.inf)
    views = Views(torch.ones(1, 64, 64, 3), hit.float(), c2w, K, torch.zeros(1), 2.0, depth, torch.zeros(1, 64, 64, 4))
    geometry = lift_geometry(views)
    g, pixel = geometry.gaussians, geometry.pixel_index
    axes = rotation_matrix(g.rotation)
    assert (axes[..., 1, 2] < -0.9999).all()  # towards the camera
    size = depth.flatten()[pixel] / 70
    slant = 1 / direction.reshape(-1, 3)[pixel, 1]
    centre = (direction.reshape(-1, 3)[pixel] @ c2w[0, :3, 2]) > 0.995  # where a pixel is round
    assert centre.sum() > 50
    torch.testing.assert_close(g.scale[centre, 0], (0.35 * size * slant)[centre], rtol=0.04, atol=0)
    torch.testing.assert_close(g.scale[centre, 1], (0.35 * size)[centre], rtol=0.04, atol=0)


def test_a_lone_pixel_and_an_empty_view_are_finite(spheres):
    views = spheres([0, 1])
    keep = torch.zeros_like(views.alpha)
    row, column = (views.alpha[0] > 0).nonzero()[0].tolist()
    keep[0, row, column] = 1
    views.alpha = keep
    g = lift(views)
    assert len(g) >= 1 and all(torch.isfinite(getattr(g, k)).all() for k in ("xyz", "scale", "rotation", "sigma_t"))


def test_views_are_looked_at_some_at_a_time_with_the_same_outcome(spheres, monkeypatch):
    views = spheres(range(24))
    whole = lift(views)
    monkeypatch.setattr("timesplat.model.geometry.lift.AT_ONCE", 5)
    parts = lift(views)
    for a, b in zip(vars(whole).values(), vars(parts).values(), strict=True):
        torch.testing.assert_close(a, b, atol=1e-6, rtol=0)
