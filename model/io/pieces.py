# SPDX-License-Identifier: GPL-3.0-or-later
"""Gaussians on paths as straight 4D Gaussians, for whatever knows no paths. numpy only, for inside Blender.

What stands still or goes straight all through the clip is one Gaussian. Anything else is a row of pieces that fade into
one another: each goes straight along the path and does not turn, with a lifetime of SPREAD times its length. Several
lie over one another at any time, and 1 - Π (1 - alpha) of them is to be what the one Gaussian shows: so theirs are
another opacity and a slightly smaller size. Neighbours change over at different times, which averages out what is left
of a ripple.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .asset import ARRAYS, STATIC_SIGMA_T, Asset
from .paths import WINDOW_SLACK, inverse, multiply, rotate

SPREAD = 0.46  # σ_t of a piece by its length: with more overlap pieces stray from a bend, with less they flicker
# By the Gaussian's opacity what its pieces' opacities and sizes are multiplied by, so that 1 - Π (1 - alpha) of them is
# its own alpha: least squares over the splat and time.
OPACITY = (0, 0.25, 0.5, 0.75, 0.94, 1)
OPACITY_FACTOR = (0.867, 0.908, 0.952, 1.008, 1.054, 1)
SIZE_FACTOR = (1, 0.989, 0.976, 0.963, 0.951, 0.977)
BEYOND = 1.25  # lengths by which pieces go on beyond the clip's ends: of one further off 2 % would be left inside
EDGE = 0.1  # of a frame and up to twice that: the first piece where a path begins or ends within the clip
PHASES, GOLDEN = 8, 0.618034  # how many different times there are at which neighbours change over, and who takes which
MOMENTS = 1 << 20  # Gaussians times frames that are worked on at once
PIXELS, TOLERANCE = 0.125, 1e-3  # by which a piece may miss its Gaussian; in normalised units where no pixel is known


def to_pieces(asset: Asset, per_frame: int = 1) -> Asset:
    """The asset without paths; itself where it has none. As few pieces as miss by less than PIXELS or TOLERANCE, at
    most `per_frame` a frame but for the ends of paths within the clip."""
    if asset.paths is None:
        return asset
    block = max(MOMENTS // len(asset.clip.frames), 1)
    parts = [_pieces(asset[np.arange(i, min(i + block, len(asset)))], per_frame) for i in range(0, len(asset), block)]
    return Asset(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in ARRAYS}, clip=asset.clip)


def _pieces(asset: Asset, per_frame: int) -> Asset:
    frame = 2 / max(asset.clip.frame_end - asset.clip.frame_start, 1)
    start, end = (np.clip(a, -2, 2) for a in _window(asset, np.arange(len(asset))))
    phase = np.floor(np.arange(len(asset)) * GOLDEN % 1 * PHASES) / PHASES
    kinds = np.stack([start, end, _lengths(asset, frame / per_frame), phase], 1)
    kinds, kind = np.unique(kinds, axis=0, return_inverse=True)
    rows = [_row(s, e, long, p, EDGE * frame * 2**p) for s, e, long, p in kinds.tolist()]
    many, kind = np.array([len(r) for r in rows]), kind.reshape(-1)
    owner = np.repeat(np.arange(len(asset)), many[kind])
    place = np.arange(len(owner)) - np.repeat(np.cumsum(many[kind]) - many[kind], many[kind])  # in the owner's row
    t, length = np.concatenate(rows)[(np.cumsum(many) - many)[kind[owner]] + place].T
    xyz, velocity, rotation = _lines(asset, owner, t, length)
    alone, opacity = np.isinf(length), asset.opacity[owner]
    as_opaque, as_large = (np.where(alone, 1, np.interp(opacity, OPACITY, f)) for f in (OPACITY_FACTOR, SIZE_FACTOR))
    arrays = {
        "xyz": xyz,
        "t": t,
        "velocity": velocity,
        "sigma_t": np.where(alone, STATIC_SIGMA_T, SPREAD * length),
        "scale": asset.scale[owner] * as_large[:, None],
        "rotation": rotation,
        "rgb": asset.rgb[owner],
        "opacity": opacity * as_opaque,
    }
    exact: dict[str, Any] = {name: np.ascontiguousarray(a, np.float32) for name, a in arrays.items()}
    return Asset(**exact, clip=asset.clip)


def _row(start: float, end: float, length: float, phase: float, edge: float) -> np.ndarray:
    """(M,2) times and lengths of the pieces of a Gaussian that is there from start to end, where `length` is as long as
    they may be, infinite for what one line is enough for. Within the clip the first and the last have the length `edge`
    and their times at the very end, and each next one is twice as long."""
    begins, ends = start > WINDOW_SLACK - 1, end < 1 - WINDOW_SLACK
    if ends and not begins:
        return _row(-end, -start, length, phase, edge) * [-1, 1]
    if not begins and np.isinf(length):
        return np.array([[0, length]])
    if not begins:
        t = np.arange(-1 - (BEYOND - phase) * length, 1 + BEYOND * length, length)
        return np.stack([t, np.full_like(t, length)], 1)
    sizes: list[float] = []
    size, whole = edge, end - start + edge
    if ends:
        while 2 * (sum(sizes) + size) < whole and size < length:
            sizes.append(size)
            size *= 2
        gap = whole - 2 * sum(sizes)
        many = round(gap / min(size, length))
        sizes += [gap / max(many, 1)] * many + sizes[::-1]
    else:
        while sum(sizes) < whole + (BEYOND - 0.5) * size:
            sizes.append(size)
            size = min(2 * size, length)
    lengths = np.array(sizes) * (whole / sum(sizes) if ends else 1)  # a gap too short for a piece is shared out
    return np.stack([start - edge / 2 + lengths.cumsum() - lengths / 2, lengths], 1)


def _lengths(asset: Asset, shortest: float) -> np.ndarray:
    """(N,) how long a Gaussian's pieces may be so as not to miss: `shortest` times 1, 2, 4 or 8, or without limit."""
    tolerance, reach = PIXELS * asset.clip.pixel or TOLERANCE, asset.scale.max(1)
    steps = np.arange(-1, 1 + shortest, shortest)
    lengths, left = np.full(len(asset), shortest), np.arange(len(asset))
    for length in (np.inf, 8 * shortest, 4 * shortest, 2 * shortest):
        alone = np.isinf(length)
        t = np.zeros(1) if alone else np.arange(-1, 1 + length / 2, length)
        owner, t = np.repeat(left, len(t)), np.tile(t, len(left))
        xyz, velocity, rotation = _lines(asset, owner, t, np.full(len(t), length))
        worst = np.zeros(len(t))
        for dt in steps if alone else (-length / 2, length / 2):
            time = np.clip(t + dt, *_window(asset, owner))
            there, turn = _poses(asset, owner, time)
            turned = 2 * np.linalg.norm(multiply(turn, inverse(rotation))[:, 1:], axis=1)
            miss = np.linalg.norm(xyz + velocity * (time - t)[:, None] - there, axis=1) + turned * reach[owner]
            worst = np.maximum(worst, miss)
        good = worst.reshape(len(left), -1).max(1) < tolerance
        lengths[left[good]] = length
        left = left[~good]
        if not len(left):
            break
    return lengths


def _lines(asset: Asset, rows: np.ndarray, t: np.ndarray, length: np.ndarray) -> tuple[np.ndarray, ...]:
    """Positions (M,3) at the times t (M,), velocities (M,3) and rotations (M,4) of pieces of the Gaussians `rows` (M,):
    with where they are at t and √3 σ_t before and after, weighted so that the mean of the pieces of a bend is on it."""
    half = np.where(np.isinf(length), 1, 3**0.5 * SPREAD * length)
    start, end = _window(asset, rows)
    times = [np.clip(t + dt, start, end) for dt in (-half, 0, half)]
    (before, _), (middle, rotation), (after, _) = (_poses(asset, rows, time) for time in times)
    velocity = (after - before) / np.maximum(times[2] - times[0], 1e-9)[:, None]
    mean = (before + 4 * middle + after) / 6
    return mean + velocity * (t - (times[0] + 4 * times[1] + times[2]) / 6)[:, None], velocity, rotation


def _window(asset: Asset, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    paths, path = asset.riding()
    return paths.start[path[rows]], paths.end[path[rows]]


def _poses(asset: Asset, rows: np.ndarray, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions (M,3) and rotations (M,4) of the Gaussians `rows` (M,), each at its time (M,)."""
    (paths, path), (offset, rotation) = asset.riding(), asset.on_path()
    place, turn = paths.at(time, path[rows])
    return place + rotate(turn, offset[rows]), multiply(turn, rotation[rows])
