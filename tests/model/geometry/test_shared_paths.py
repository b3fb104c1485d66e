# SPDX-License-Identifier: GPL-3.0-or-later
"""Shared paths: everything stays within the tolerance, and rigid things share one path of few knots."""

import math

import pytest
import torch

from timesplat.model.geometry.shared_paths import knots, ride
from timesplat.model.rotations import rotate, rotation_matrix


def turning(points, frames, turns=0.5, way=0.5):
    """Points (N,3) that turn about z and go along x -> place (N,F,3), turn (N,F,4)."""
    angle = torch.linspace(0, turns * 2 * math.pi, frames)
    q = torch.stack([(angle / 2).cos(), 0 * angle, 0 * angle, (angle / 2).sin()], -1)
    place = torch.einsum("fij,nj->nfi", rotation_matrix(q), points)
    place[..., 0] += torch.linspace(0, way, frames)
    return place, q.expand(len(points), frames, 4).clone()


def furthest(place, window, path, offset, paths):
    """The greatest distance of a point from where its path carries it, at the frames at which it is there."""
    frames, worst = place.shape[1], 0.0
    for f in range(frames):
        t = 2 * f / (frames - 1) - 1
        p, q = paths.at(t)
        here = (window[:, 0] <= f) & (f <= window[:, 1])
        assert torch.equal(paths.there(t)[path], here)
        away = (p[path] + rotate(q[path], offset) - place[:, f]).norm(dim=-1)
        worst = max(worst, float((away * here).max()))
    return worst


def window_of(n, first=0, last=8):
    return torch.tensor([[first, last]]).expand(n, 2).clone()


def test_what_is_rigid_rides_on_one_path():
    place, turn = turning(torch.randn(300, 3, generator=torch.Generator().manual_seed(0)), 9)
    path, offset, rotation, paths = ride(place, turn, window_of(300), 0.01)
    assert len(paths) <= 8
    assert furthest(place, window_of(300), path, offset, paths) < 0.02
    assert torch.allclose(rotation.abs()[:, 0], torch.ones(300), atol=1e-5)


def test_what_stands_still_has_one_knot_and_what_goes_straight_two():
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(0))
    still, turn = turning(points, 9, turns=0, way=0)
    assert ride(still, turn, window_of(50), 0.01)[3].count.max() == 1
    straight, turn = turning(points, 9, turns=0, way=1)
    assert set(ride(straight, turn, window_of(50), 0.01)[3].count.tolist()) == {2}


@pytest.mark.parametrize("tolerance", [0.05, 0.005])
def test_what_bends_keeps_within_the_tolerance(tolerance):
    rng = torch.Generator().manual_seed(0)
    points = torch.rand(400, 3, generator=rng) * 2 - 1
    frames = 24
    place = points[:, None].repeat(1, frames, 1)
    place[..., 2] += 0.3 * torch.sin(3 * points[:, None, 0] + torch.linspace(0, 6, frames))
    turn = torch.tensor([1.0, 0, 0, 0]).expand(400, frames, 4).clone()
    window = window_of(400, 0, 23)
    path, offset, _, paths = ride(place, turn, window, tolerance)
    assert furthest(place, window, path, offset, paths) <= 2 * tolerance
    assert len(paths) < 400


def test_windows_are_kept_apart():
    place, turn = turning(torch.randn(60, 3, generator=torch.Generator().manual_seed(0)), 9)
    window = window_of(60)
    window[20:40] = torch.tensor([3, 5])
    window[40:] = torch.tensor([0, 0])
    path, offset, _, paths = ride(place, turn, window, 0.001)
    assert furthest(place, window, path, offset, paths) < 0.002
    assert not set(path[:20].tolist()) & set(path[20:40].tolist())


def test_a_clip_of_one_frame():
    place, turn = turning(torch.randn(30, 3, generator=torch.Generator().manual_seed(0)), 9)
    path, offset, _, paths = ride(place[:, :1], turn[:, :1], window_of(30, 0, 0), 0.001)
    p, q = paths.at(0.0)
    assert torch.allclose(p[path] + rotate(q[path], offset), place[:, 0], atol=1e-5) and paths.there(0.0).all()


def test_knots_turn_the_short_way():
    place, turn = turning(torch.zeros(1, 3), 9, turns=1)
    turn[:, 4:] *= -1  # the same rotations
    paths = knots(place, turn, window_of(1), torch.ones(1), 0.01)
    neighbours = (paths.rotation[1:] * paths.rotation[:-1]).sum(-1)
    assert (neighbours > 0).all()
