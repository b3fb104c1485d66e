# SPDX-License-Identifier: GPL-3.0-or-later
"""Where paths are between the frames at which they are known: on a smooth curve through these, that goes straight
where the motion is not smooth.

A turn about a far axis takes a path's place on an arc, but every rigid motion at even pace has an axis that stands
still or goes straight. So a path is first moved to where its own place bends least (`pivots`).
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from ..rotations import conjugate, quaternion_multiply, rotation_matrix

LIKE = 3.0  # times as much as at the one end of a frame may motion bend at the other, or it is taken for a jolt
OPPOSED = -0.6  # cosine of the angle between the two beyond which it is one as well
FARTHEST = 2.0  # that a path is moved, normalised units: the object is as wide
ROUNDS = 5  # in which steps that do not fit, as jumps, come to count less


def _bends(way: Tensor, window: Tensor) -> Tensor:
    """way (P,F-1,C) from each frame to the next, window (P,2) first and last frame at which it is known -> (P,F,C) how
    much more it is after a frame than before; 0 from the window's ends on outwards."""
    frames = torch.arange(way.shape[1] + 1)
    inside = (frames > window[:, :1]) & (frames < window[:, 1:])
    return torch.where(inside[..., None], F.pad(way.diff(dim=1), (0, 0, 1, 1)), 0.0)


def pivots(place: Tensor, turn: Tensor, window: Tensor, tolerance: float) -> Tensor:
    """place (P,F,3), turn (P,F,4) unit quaternions, window (P,2) -> (P,3), in each path's moving frame, of the points
    that go straightest; 0 where the path's own place is within the tolerance of going straight from frame to frame, or
    no other point does half as well."""
    bend = _bends(place.double().diff(dim=1), window)
    turning = _bends(rotation_matrix(turn.double()).flatten(2).diff(dim=1), window).unflatten(2, (3, 3))
    pivot, left = bend.new_zeros(len(place), 3), bend
    for _ in range(ROUNDS):
        weight = 1 / (left.norm(dim=-1) + tolerance)[..., None, None]
        square = (turning.mT @ (weight * turning)).sum(1)
        # Along the axis any point does as well: the nearest.
        ridge = 1e-6 * square.diagonal(dim1=1, dim2=2).sum(1) + 1e-12
        square = square + ridge[:, None, None] * torch.eye(3, dtype=bend.dtype)
        pivot = -torch.linalg.solve(square, (turning.mT @ (weight * bend[..., None])).sum(1))[..., 0]
        left = bend + (turning @ pivot[:, None, :, None])[..., 0]
    known = (torch.arange(place.shape[1]) > window[:, :1]) & (torch.arange(place.shape[1]) < window[:, 1:])
    before, after = (torch.where(known, x.norm(dim=-1), torch.nan).nanmedian(1).values for x in (bend, left))
    off = bend.norm(dim=-1).amax(1) / 8  # half-way between frames
    better = (off > tolerance) & (after < before / 2) & (pivot.norm(dim=-1) < FARTHEST)
    return torch.where(better[:, None], pivot, 0.0).to(place.dtype)


def smooth(place: Tensor, window: Tensor, steps: int) -> Tensor:
    """place (P,F,3) at whole frames, window (P,2) -> (P,steps·(F-1)+1,3), `steps` from each frame to the next."""
    between = place[:, :-1, None] + _ways(place.diff(dim=1), window, steps)
    return torch.cat([between.flatten(1, 2), place[:, -1:]], 1)


def smooth_turns(turn: Tensor, window: Tensor, steps: int) -> Tensor:
    """turn (P,F,4) unit quaternions -> (P,steps·(F-1)+1,4), likewise, by the shorter turn from frame to frame."""
    ways = _ways(_vector(quaternion_multiply(conjugate(turn[:, :-1]), turn[:, 1:])), window, steps)
    between = quaternion_multiply(turn[:, :-1, None].expand(-1, -1, steps, -1), _turn(ways))
    return torch.cat([between.flatten(1, 2), turn[:, -1:]], 1)


def _ways(way: Tensor, window: Tensor, steps: int) -> Tensor:
    """way (P,F-1,C) from each frame to the next -> (P,F-1,steps,C) that from each frame to the steps after it.

    On Catmull and Rom's curve, that is by how much the ways bend at both ends of each; but at the one end at most LIKE
    times as much as at the other, and not where the other way round: what jumps neither overshoots nor swings back, and
    what hits a wall goes straight up to it. Where it begins and ends it bends as one frame further in."""
    bend, frames = _bends(way, window), way.shape[1] + 1
    rows, (first, last) = torch.arange(len(way)), window.T
    for end, inner in ((first, first + 1), (last, last - 1)):
        here, beyond = (bend[rows, i.clamp(0, frames - 1)] for i in (inner, 2 * inner - end))
        bend[rows, end] = torch.where((last - first > 2)[:, None], _alike(here, beyond), 0.0)
    before, after = bend[:, :-1, None], bend[:, 1:, None]
    s = (torch.arange(steps) / steps)[:, None].to(way)
    return s * way[:, :, None] - s * (1 - s) / 2 * torch.lerp(_alike(before, after), _alike(after, before), s)


def _alike(bend: Tensor, other: Tensor) -> Tensor:
    """Bends (…,C), no longer than LIKE times the others (…,C), and 0 where these are opposed to them."""
    length, others = (x.norm(dim=-1, keepdim=True) for x in (bend, other))
    opposed = (bend * other).sum(-1, keepdim=True) < OPPOSED * length * others
    return torch.where(opposed, 0.0, bend * (LIKE * others / length.clamp_min(1e-12)).clamp_max(1))


def _vector(turn: Tensor) -> Tensor:
    """Unit quaternions (…,4) -> (…,3) the axis times the angle, the shorter way."""
    turn = torch.where(turn[..., :1] < 0, -turn, turn)
    length = turn[..., 1:].norm(dim=-1, keepdim=True)
    return 2 * torch.atan2(length, turn[..., :1]) / length.clamp_min(1e-12) * turn[..., 1:]


def _turn(vector: Tensor) -> Tensor:
    """The way back: (…,3) -> unit quaternions (…,4)."""
    half = vector.norm(dim=-1, keepdim=True) / 2
    return torch.cat([half.cos(), torch.sinc(half / torch.pi) / 2 * vector], -1)
