# SPDX-License-Identifier: GPL-3.0-or-later
"""Tracks from depth and motion vectors on scenes known by hand: errors in pixels."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from timesplat.datagen.rigs import spherical
from timesplat.datagen.sequence import opengl_to_opencv
from timesplat.datagen.track_file import read_tracks, write_tracks
from timesplat.model.geometry.motion_tracks import MOTION, motion_tracks
from timesplat.model.geometry.surface_tracks import surface_tracks
from timesplat.model.rotations import rotation_matrix
from timesplat.model.views import Views, rays

FRAMES = list(range(24))
CAMERAS = [(90 * (f % 4), 0) for f in FRAMES]
RADIUS, TURN = 0.6, 0.06  # of the ball: radians a frame about y


@pytest.fixture(scope="module")
def views(spheres):
    return spheres(FRAMES)


@pytest.fixture(scope="module")
def tracks(views):
    return motion_tracks(views)


def turning_ball(size: int = 48) -> Views:
    """A ball in the middle that turns, seen from four sides in turn."""
    c2w = torch.tensor(np.stack([opengl_to_opencv(spherical(*c)) for c in CAMERAS]), dtype=torch.float32)
    K = torch.tensor([[size * 1.07, size * 1.07, size / 2, size / 2]]).expand(24, 4).contiguous()
    origin, way = (x.double() for x in rays(c2w, K, size, size))
    b = (origin * way).sum(-1)
    root = b * b - (origin * origin).sum(-1) + RADIUS**2
    hit = root > 0
    place = origin + way * (-b - root.clamp_min(0).sqrt())[..., None]
    w2c = torch.linalg.inv(c2w.double())

    def project(p):
        local = torch.einsum("vij,vhwj->vhwi", w2c[:, :3, :3], p) + w2c[:, None, None, :3, 3]
        return local[..., :2] / local[..., 2:] * K[0, 0], local[..., 2]

    here, depth = project(place)
    flow = [project(place @ turned(sign * TURN).T)[0] - here for sign in (1, -1)]
    flow = (torch.cat(flow, -1) * hit[..., None]).float()
    depth = torch.where(hit, depth, torch.inf).float()
    time = torch.linspace(-1, 1, 24)
    return Views(torch.full((24, size, size, 3), 0.5), hit.float(), c2w, K, time, 2 / 23, depth, flow)


def turned(angle: float) -> torch.Tensor:
    c, s = np.cos(angle), np.sin(angle)
    return torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]], dtype=torch.float64)


def there(tracks) -> np.ndarray:
    """(N,F) bool"""
    frame = np.arange(tracks.position.shape[1])
    return (frame >= tracks.first[:, None]) & (frame <= tracks.last[:, None])


def test_points_go_with_what_they_are_on(spheres, views, tracks):
    """Of straight motion: from a point's place at the middle of its life its places at all others are known."""
    n, middle = len(tracks), (tracks.first + tracks.last) // 2
    place = tracks.position[np.arange(n), middle]
    motion = spheres.truth(place, middle)
    truth = place[:, None] + motion[:, None] * (np.arange(24) - middle[:, None])[..., None]
    error = np.linalg.norm(tracks.position - truth, axis=-1)[there(tracks)] / views.pixel
    assert np.median(error) < 0.2 and np.percentile(error, 95) < 1
    assert np.median(tracks.last - tracks.first) > 12


def test_one_point_a_pixel_of_surface_and_not_one_a_pixel_of_every_view(views, tracks):
    surface = 4 * np.pi * (0.38**2 + 0.3**2 + 0.25**2)
    assert 0.5 < len(tracks) / (surface / views.pixel**2) < 2.5
    assert len(tracks) < 0.25 * float(views.alpha.sum())


def test_a_turning_ball():
    """Points, and their frames of reference, turn with it; normals look out of it."""
    views = turning_ball()
    tracks = motion_tracks(views)
    alive, n = there(tracks), len(tracks)
    middle = (tracks.first + tracks.last) // 2
    turn = torch.stack([turned(TURN * k) for k in range(-23, 24)]).numpy()[np.arange(24) - middle[:, None] + 23]
    truth = (turn @ tracks.position[np.arange(n), middle][:, None, :, None])[..., 0]
    error = np.linalg.norm(tracks.position - truth, axis=-1)[alive] / views.pixel
    assert np.median(error) < 0.2 and np.percentile(error, 95) < 1
    off = np.abs(np.linalg.norm(tracks.position, axis=-1) - RADIUS)[alive] / views.pixel
    assert np.percentile(off, 95) < 0.3
    axes = rotation_matrix(torch.from_numpy(tracks.rotation.astype(np.float32))).numpy()
    cosine = (axes[..., 2] * tracks.position / RADIUS).sum(-1)[alive]
    assert np.median(cosine) > 0.98 and np.percentile(cosine, 5) > 0.85
    away = turn @ axes[np.arange(n), middle][:, None] - axes
    assert np.median(np.linalg.norm(away, axis=(-2, -1))[alive]) < 0.15
    q = tracks.rotation.astype(np.float32)
    assert ((q[:, 1:] * q[:, :-1]).sum(-1) > 0).all()


def without_third(spheres, before: int) -> Views:
    """The spheres, the third of which is not there before that frame."""
    views = spheres([f for f in FRAMES for _ in range(2)], [(a, 20) for f in FRAMES for a in (90 * (f % 4), 200)])
    origin, way = rays(views.c2w, views.intrinsics, *views.size)
    z = torch.where(views.alpha > 0, views.depth, 0.0)
    place = origin + way * (z / (way * views.c2w[:, None, None, :3, 2]).sum(-1))[..., None]
    frame = (views.time * 11.5 + 11.5).round()
    for v in range(len(views)):
        third = torch.from_numpy(on_third(place[v].flatten(0, 1).numpy(), int(frame[v]))).unflatten(0, views.size)
        if frame[v] < before:
            views.alpha[v][third], views.depth[v][third] = 0, torch.inf
    return views


def on_third(place: np.ndarray, frame) -> np.ndarray:
    """(n,) bool: whether places (n,3) at a frame (scalar or (n,)) are on the third sphere."""
    centre = np.array([0.2, 0.35, 0.4]) + np.array([0, -0.025, 0]) * (np.asarray(frame).reshape(-1, 1) - 11.5)
    return np.abs(np.linalg.norm(place - centre, axis=-1) - 0.25) < 0.02


def test_what_appears_is_there_from_then_on(spheres):
    tracks = motion_tracks(without_third(spheres, 12))
    third = on_third(tracks.position[np.arange(len(tracks)), tracks.last], tracks.last)
    assert third.sum() > 50
    assert np.percentile(tracks.first[third], 10) >= 10 and np.median(tracks.last[third]) >= 20
    assert np.median(tracks.first[~third]) < 6


def test_known_points_start_no_others(spheres, views, tracks):
    assert len(motion_tracks(views, tracks)) < 0.15 * len(tracks)
    third = on_third(tracks.position[:, 12], 12)
    known = replace(tracks, **{k: getattr(tracks, k)[third] for k in ("position", "rotation", "first", "last", "area")})
    rest = motion_tracks(views, known)
    assert on_third(rest.position[:, 12], 12).sum() < 0.3 * third.sum()
    assert len(rest) > 0.7 * (len(tracks) - third.sum())


def test_they_are_surface_tracks_like_any(views, tracks, tmp_path):
    """The file takes them, and the same start is made of them."""
    write_tracks(tmp_path / "tracks.npz", tracks)
    again = read_tracks(tmp_path / "tracks.npz", 24)
    np.testing.assert_array_equal(again.position, tracks.position)
    found = surface_tracks(tracks, views)
    assert len(found) >= 0.9 * len(tracks)
    assert all(torch.isfinite(getattr(found, k)).all() for k in ("offset", "scale", "rotation", "rgb"))


def test_a_moment_and_nothing_at_all(spheres):
    still = spheres([12])
    still = replace(still, time=torch.zeros(1), frame_step=2.0, flow=torch.zeros_like(still.flow))
    tracks = motion_tracks(still)
    assert tracks.position.shape == (len(tracks), 1, 3) and 100 < len(tracks) <= int(still.alpha.sum())
    nothing = motion_tracks(replace(still, alpha=torch.zeros_like(still.alpha)))
    assert nothing.position.shape == (0, 1, 3) and nothing.rotation.shape == (0, 1, 4)


def test_fine_pictures_start_no_more_points_than_a_fit_can_use():
    views = turning_ball(96)
    shown = float((views.alpha > 0.5).float().sum((1, 2)).mean())
    every, some = (motion_tracks(views, settings=MOTION._replace(most_pixels=shown / n)) for n in (1, 4))
    assert 0.15 < len(some) / len(every) < 0.4
    assert some.area.sum() == pytest.approx(every.area.sum(), rel=0.3)
    away = np.linalg.norm(some.position, axis=-1)[there(some)]
    assert np.abs(away - RADIUS).max() < 2 * views.pixel
