# SPDX-License-Identifier: GPL-3.0-or-later
"""Paths between frames against motion that is known there: smooth motion comes near, jolts go straight."""

import math

import pytest
import torch

from timesplat.model.geometry.between_frames import pivots, smooth, smooth_turns
from timesplat.model.geometry.shared_paths import ride
from timesplat.model.rotations import rotate, rotation_matrix

FRAMES, STEPS = 12, 4
TIME = torch.arange(STEPS * (FRAMES - 1) + 1) / STEPS  # in frames
ALL = torch.tensor([[0, FRAMES - 1]])


def whole(x):
    """Of what is known at every step (N,S,C) the frames."""
    return x[:, ::STEPS]


def spinning(degrees, way=0.0, points=200):
    """A rigid body (N points) that turns by so much a frame about a tilted axis, while that goes its way."""
    rng = torch.Generator().manual_seed(0)
    axis = torch.tensor([0.2, -1, 0.3]) / math.sqrt(1.13)
    half = math.radians(degrees) * TIME / 2
    turn = torch.cat([half.cos()[:, None], half.sin()[:, None] * axis], 1)
    body = torch.rand(points, 3, generator=rng) - 0.5
    place = torch.einsum("sij,nj->nsi", rotation_matrix(turn), body) + way * TIME[:, None]
    return place, turn.expand(points, -1, 4).clone()


def carried(place, turn, tolerance=1e-3):
    """How far points (N,S,3), known at whole frames to `ride`, are at every step from where they are carried."""
    window = ALL.expand(len(place), 2)
    path, offset, _, paths = ride(whole(place), whole(turn), window, tolerance)
    away = []
    for i, t in enumerate((2 * TIME / (FRAMES - 1) - 1).tolist()):
        p, q = paths.at(t)
        away.append((p[path] + rotate(q[path], offset) - place[:, i]).norm(dim=-1))
    return torch.stack(away, 1), paths


@pytest.mark.parametrize("degrees", [5, 60, 100])
@pytest.mark.parametrize("way", [0.0, 0.1])
def test_what_spins_is_right_between_frames(degrees, way):
    """Straight from frame to frame it would be off by 1 - cos(degrees / 2) of its distance from the axis."""
    place, turn = spinning(degrees, way)
    away, paths = carried(place, turn)
    assert away.max() < 4e-3 and len(paths) <= 8


def test_what_spins_about_what_stands_still_needs_no_more_knots_than_frames():
    place, turn = spinning(60)
    _, paths = carried(place, turn, 0.01)
    assert paths.count.max() <= FRAMES
    assert paths.place[: paths.count[0]].std(0).max() < 1e-4, "the path must be that of a point of the axis"


@pytest.mark.parametrize(("degrees", "most"), [(15, 4e-4), (60, 0.03), (90, 0.12)])
def test_what_goes_round_without_turning(degrees, most):
    """Of the circle's radius, 1, a straight path loses 0.0086, 0.13 and 0.29."""
    angle = math.radians(degrees) * TIME
    circle = torch.stack([angle.cos(), angle.sin(), 0 * angle], -1)[None]
    found = smooth(whole(circle), ALL, STEPS)
    inner = slice(2 * STEPS, -2 * STEPS)
    assert (found - circle)[:, inner].norm(dim=-1).max() < most
    assert torch.equal(whole(found), whole(circle))


def test_what_jumps_goes_straight_and_nothing_swings():
    jump = torch.zeros(3, FRAMES, 1)
    jump[0, 5:] = 1.0
    jump[1, 1:] = 1.0
    jump[2, -1:] = 1.0
    found = smooth(jump, ALL.expand(3, 2), STEPS)[..., 0]
    straight = torch.stack([(TIME - at).clamp(0, 1) for at in (4, 0, FRAMES - 2)])
    assert torch.allclose(found, straight, atol=1e-6)


def test_what_bounces_goes_straight_up_to_the_wall():
    place = (TIME - 5).abs()[None, :, None]
    found = smooth(whole(place), ALL, STEPS)
    assert torch.allclose(found, place, atol=1e-6)


def test_turns_take_the_shorter_way_whatever_their_signs():
    _, turn = spinning(40, points=1)
    known = whole(turn).clone()
    known[:, 3:] *= -1
    found = smooth_turns(known, ALL, STEPS)
    assert ((found * turn).sum(-1).abs() > 1 - 1e-6).all()


def test_outside_of_its_window_it_stays_and_has_no_say():
    place, _ = spinning(60, points=1)
    window = torch.tensor([[3, 8]])
    held = whole(place)[:, torch.arange(FRAMES).clamp(3, 8)]
    found = smooth(held, window, STEPS)
    assert torch.equal(found[:, : 3 * STEPS], held[:, 3:4].expand(-1, 3 * STEPS, -1))
    inside = slice(4 * STEPS, 7 * STEPS)
    assert torch.allclose(found[:, inside], smooth(whole(place), ALL, STEPS)[:, inside], atol=1e-6)


def test_a_pivot_is_on_the_axis_even_where_the_body_jumps_once():
    place, turn = spinning(30, points=4)
    place[:, 6 * STEPS :] += 0.5
    pivot = pivots(whole(place), whole(turn), ALL.expand(4, 2), 1e-3)
    at = place[:, 0] + rotate(turn[:, 0], pivot)
    axis = torch.tensor([0.2, -1, 0.3]) / math.sqrt(1.13)
    assert (at - (at @ axis)[:, None] * axis).norm(dim=-1).max() < 0.02


def test_what_goes_straight_or_turns_in_place_keeps_its_own():
    place, turn = spinning(20, points=5)
    still = turn[:, :1].expand_as(turn)
    assert not pivots(whole(place[:, :1].expand_as(place)), whole(turn), ALL.expand(5, 2), 1e-3).any()
    assert not pivots(whole(place), whole(still), ALL.expand(5, 2), 1e-3).any()


@pytest.mark.parametrize("frames", [2, 3])
def test_clips_of_few_frames(frames):
    place, turn = spinning(30, points=20)
    place, turn = whole(place)[:, :frames], whole(turn)[:, :frames]
    window = torch.tensor([[0, frames - 1]]).expand(20, 2)
    path, offset, _, paths = ride(place, turn, window, 1e-3)
    for f in range(frames):
        p, q = paths.at(2 * f / (frames - 1) - 1)
        assert (p[path] + rotate(q[path], offset) - place[:, f]).norm(dim=-1).max() < 2e-3
