# SPDX-License-Identifier: GPL-3.0-or-later
"""As few paths as surface points need: points of one rigid part ride on one path, and a path has as few knots as keep
it within a tolerance, at every frame and, where motion is smooth, of a smooth curve between them
(`between_frames.py`).

A path is that of one of the points, or of its pivot. It takes all points along whose distance from where it would
carry them stays within the tolerance at every frame; from few, spread over all, to more and more, until every point
rides.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from ..rotations import conjugate, quaternion_multiply, rotate
from ..tracks import Paths
from .between_frames import pivots, smooth, smooth_turns

FIRST_SEEDS = 24  # paths that are tried first
SEED_SHARE = 0.12  # of the points that are left are tried as paths in each later round
NEAREST = 4  # paths, by their place at one frame, of which each point takes the one that carries it best
BLOCK = 4_000_000  # distances computed at a time
STEPS = 4  # from frame to frame, at which a path is looked at
BETWEEN = 2.0  # times the tolerance are allowed between frames


def share_paths(place: Tensor, turn: Tensor, window: Tensor, tolerance: float, seed: int = 0) -> tuple[Tensor, Tensor]:
    """place (N,F,3), turn (N,F,4) and window (N,2) of N points: only points of one window share a path ->
    the point whose path each rides on (N,), and its offset in that moving frame (N,3): the mean over the frames."""
    n = len(place)
    generator = torch.Generator().manual_seed(seed)
    owner, offset = torch.arange(n), place.new_zeros(n, 3)
    _, group = window.unique(dim=0, return_inverse=True)
    for g in range(int(group.max()) + 1 if n else 0):
        left = (group == g).nonzero()[:, 0]
        first, last = window[left[0]].tolist()
        x, q = place[:, first : last + 1], turn[:, first : last + 1]
        seeds = FIRST_SEEDS
        while len(left):
            chosen = left[torch.randperm(len(left), generator=generator)[:seeds]]
            best, away, error = _carried(x, q, left, _carriers(x, q, chosen, tolerance))
            rides = error <= tolerance
            owner[left[rides]], offset[left[rides]] = best[rides], away[rides]
            left = left[~rides]
            seeds = max(FIRST_SEEDS, math.ceil(SEED_SHARE * len(left)))
    return owner, offset


def _carriers(x: Tensor, q: Tensor, seeds: Tensor, tolerance: float) -> Tensor:
    """Those of the seeds (S,) that none before them carries within the tolerance."""
    near, _, error = _candidates(x, q, seeds, seeds, NEAREST + 1)
    good = (error <= tolerance).numpy()
    taken, kept = [False] * len(seeds), []
    carried_by: list[list[int]] = [[] for _ in range(len(seeds))]
    for i, row in enumerate(near.tolist()):
        for j, ok in zip(row, good[i], strict=True):
            if ok and i != j:
                carried_by[j].append(i)
    for i in range(len(seeds)):
        if not taken[i]:
            kept.append(i)
            for j in carried_by[i]:
                taken[j] = True
    return seeds[kept]


def _candidates(x: Tensor, q: Tensor, points: Tensor, seeds: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Of each of the points (n,) the `count` nearest seeds (n,k), as rows of `seeds`; where the point is in their
    frames on the mean (n,k,3); and the greatest distance from where each would carry it (n,k)."""
    middle, k = x.shape[1] // 2, min(count, len(seeds))
    found = []
    for part in points.split(max(BLOCK // (k * x.shape[1] * 3), 1)):
        near = torch.cdist(x[part, middle], x[seeds, middle]).topk(k, largest=False).indices
        carrier = seeds[near]
        local = rotate(conjugate(q[carrier]), x[part][:, None] - x[carrier])  # (n,k,F,3)
        mean = local.mean(2)
        found.append((near, mean, (local - mean[:, :, None]).square().sum(-1).amax(2).sqrt()))
    return tuple(map(torch.cat, zip(*found, strict=True)))


def _carried(x: Tensor, q: Tensor, points: Tensor, seeds: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """x (N,F,3), q (N,F,4) -> of each of the points (n,) the seed that carries it best, the offset from it (n,3), and
    the greatest distance from where it would carry it (n,). A seed carries itself."""
    near, mean, error = _candidates(x, q, points, seeds, NEAREST)
    least, which = error.min(1)
    rows = torch.arange(len(points))
    best, away = seeds[near[rows, which]], mean[rows, which]
    own = torch.isin(points, seeds)
    return torch.where(own, points, best), away.masked_fill(own[:, None], 0.0), least.masked_fill(own, 0.0)


def knots(place: Tensor, turn: Tensor, window: Tensor, reach: Tensor, tolerance: float) -> Paths:
    """place (P,F,3), turn (P,F,4) at the F frames of a clip, window (P,2) the first and last frame of each, reach (P,)
    how far away from its place what rides on it is -> paths of as few evenly spaced knots as keep all of it within
    the tolerance at every frame, and BETWEEN times that between. What comes or goes within the clip is there for half a
    frame more."""
    n, frames = place.shape[:2]
    if frames == 1:
        ends = place.new_ones(n)
        return Paths(-ends, ends, torch.ones(n, dtype=torch.long), place[:, 0], turn[:, 0])
    count, found = torch.zeros(n, dtype=torch.long), []  # found: paths, knots' places, knots' rotations
    for part in torch.arange(n).split(max(BLOCK // (STEPS * frames * 3), 1)):
        for who, p, q in _fewest(place[part], turn[part], window[part], reach[part], tolerance):
            found.append((part[who], p, q))
            count[part[who]] = p.shape[1]
    start = count.cumsum(0) - count
    at_place, at_turn = place.new_zeros(int(count.sum()), 3), place.new_zeros(int(count.sum()), 4)
    for who, p, q in found:
        rows = (start[who, None] + torch.arange(p.shape[1])).flatten()
        at_place[rows], at_turn[rows] = p.flatten(0, 1), q.flatten(0, 1)
    first, last = _ends(window, frames, 1)
    time = 2 / (frames - 1)
    return Paths(first * time - 1, last * time - 1, count, at_place, at_turn)


def _ends(window: Tensor, frames: int, steps: int) -> tuple[Tensor, Tensor]:
    """(P,) each: from when to when what has these windows (P,2) is there, in steps, so many of which are a frame."""
    first = torch.where(window[:, 0] > 0, window[:, 0] - 0.5, 0.0)
    return steps * first, steps * torch.where(window[:, 1] < frames - 1, window[:, 1] + 0.5, frames - 1.0)


def _fewest(
    place: Tensor, turn: Tensor, window: Tensor, reach: Tensor, tolerance: float
) -> list[tuple[Tensor, Tensor, Tensor]]:
    """As `knots` -> paths (n,) for which so many knots are enough, these knots' places (n,k,3) and rotations (n,k,4),
    for each number of knots."""
    frames = place.shape[1]
    first, last = _ends(window, frames, STEPS)
    place, turn = smooth(place, window, STEPS), smooth_turns(turn, window, STEPS)
    window, left = STEPS * window, torch.arange(len(place))
    found = []
    for tried in _counts(frames):
        at = first[left, None] + (last - first)[left, None] * torch.linspace(0, 1, tried)
        p, q = _between(place, turn, left, at if tried > 1 else 0.5 * (first + last)[left, None])
        good = _distance(place, turn, window, reach, first, last, left, p, q) <= tolerance
        if tried == _counts(frames)[-1]:
            good[:] = True
        found.append((left[good], p[good], q[good]))
        left = left[~good]
        if not len(left):
            break
    return found


def _counts(frames: int) -> list[int]:
    """Numbers of knots that are tried; the last one has a knot at every step."""
    fewer = [k for k in (1, 2, 3, 4, 5, 7, 9, 12, 16, 24, 36, 48, 96, 144, 192) if k < frames]
    return [*fewer, *(n * (frames - 1) + 1 for n in (1, 2, STEPS))]


def _between(place: Tensor, turn: Tensor, who: Tensor, at: Tensor) -> tuple[Tensor, Tensor]:
    """The paths `who` (n,) at the (n,k) steps `at`, fractions too -> (n,k,3), (n,k,4); of what comes or goes within
    the clip the steps beyond hold its end."""
    a = at.floor().long().clamp(0, place.shape[1] - 1)
    b = (a + 1).clamp_max(place.shape[1] - 1)
    part = (at - a)[..., None]
    rows = who[:, None]
    return torch.lerp(place[rows, a], place[rows, b], part), _slerp(turn[rows, a], turn[rows, b], part)


def _slerp(a: Tensor, b: Tensor, part: Tensor) -> Tensor:
    """Between unit quaternions (…,4) by the normalised straight line."""
    return F.normalize(torch.lerp(a, b * torch.where((a * b).sum(-1, keepdim=True) < 0, -1.0, 1.0), part), dim=-1)


def _distance(
    place: Tensor,
    turn: Tensor,
    window: Tensor,
    reach: Tensor,
    first: Tensor,
    last: Tensor,
    who: Tensor,
    p: Tensor,
    q: Tensor,
) -> Tensor:
    """(n,) how far the paths `who`, with knots p (n,k,3), q (n,k,4), are from where they should be, at most, at the
    steps of their windows: by place, and by rotation at the distance `reach`; between frames by BETWEEN less. Signs
    of q are made to agree."""
    for i in range(1, q.shape[1]):
        q[:, i] *= torch.where((q[:, i] * q[:, i - 1]).sum(-1, keepdim=True) < 0, -1.0, 1.0)
    steps = torch.arange(place.shape[1], dtype=place.dtype)
    along = ((steps - first[who, None]) / (last - first)[who, None].clamp_min(1e-6)).clamp(0, 1) * (p.shape[1] - 1)
    a = along.floor().clamp_max(max(p.shape[1] - 2, 0)).long()
    b = (a + 1).clamp_max(p.shape[1] - 1)
    part = (along - a)[..., None]
    rows = torch.arange(len(who))[:, None]
    off = (torch.lerp(p[rows, a], p[rows, b], part) - place[who]).norm(dim=-1)
    apart = _slerp(q[rows, a], q[rows, b], part)
    cosine = (apart * turn[who]).sum(-1).abs().clamp_max(1)
    off = off + reach[who, None] * 2 * (1 - cosine.square()).clamp_min(0).sqrt()
    off = torch.where(steps % STEPS == 0, off, off / BETWEEN)
    inside = (steps >= window[who, :1]) & (steps <= window[who, 1:])
    return (off * inside).amax(1)


def ride(place: Tensor, turn: Tensor, window: Tensor, tolerance: float) -> tuple[Tensor, Tensor, Tensor, Paths]:
    """N points with place (N,F,3), turn (N,F,4), window (N,2) -> the row of its path (N,), offset (N,3) and rotation
    (N,4) in its moving frame, and the P paths; each point stays within twice the tolerance of where it is."""
    owner, offset = share_paths(place, turn, window, tolerance)
    carriers, path = owner.unique(return_inverse=True)
    middle = place.shape[1] // 2
    rotation = quaternion_multiply(conjugate(turn[owner, middle]), turn[:, middle])
    place, turn, window = place[carriers], turn[carriers], window[carriers]
    pivot = pivots(place, turn, window, tolerance)
    place, offset = place + rotate(turn, pivot[:, None].expand_as(place)), offset - pivot[path]
    reach = place.new_zeros(len(carriers)).scatter_reduce(0, path, offset.norm(dim=-1), "amax")
    return path, offset, rotation, knots(place, turn, window, reach, tolerance)
