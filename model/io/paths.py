# SPDX-License-Identifier: GPL-3.0-or-later
"""Paths: how moving frames of reference go through a clip, which Gaussians ride on. numpy only, for inside Blender.

A path has knots, evenly spaced in time from its start to its end; between two of them its place goes straight and its
rotation turns evenly. One knot is enough for what stands still, two for what goes straight. What rides on a path is
there from its start to its end, both included, and at no other time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

WINDOW_SLACK = 1e-4  # of model time by which a window is wider than it says: float32 times miss a frame by less


@dataclass(frozen=True)
class Paths:
    """P paths with M knots in all, float32 but for `count`; times are model times, -1..1 over the clip."""

    start: np.ndarray  # (P,) < end
    end: np.ndarray  # (P,)
    count: np.ndarray  # (P,) int32, knots of each, 1 or more
    place: np.ndarray  # (M,3) of the knots, those of one path after another, normalised space
    rotation: np.ndarray  # (M,4) unit quaternions w x y z; of two neighbours the dot product is not negative

    def __len__(self) -> int:
        return len(self.count)

    @property
    def first(self) -> np.ndarray:
        """(P,) int64, index of each path's first knot."""
        return np.cumsum(self.count, dtype=np.int64) - self.count

    def segment(self, time, rows=slice(None)) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of the paths `rows` (indices, repeats allowed; all of them by default) the knots before and after a time
        (one, or one for each), int64, and how far it is between them, float32 in 0..1. Beyond its ends a path stays
        where its end is."""
        start, count, first = self.start[rows], self.count[rows], self.first[rows]
        span = np.maximum(self.end[rows] - start, np.float32(1e-9))
        along = np.clip((np.asarray(time, np.float32) - start) / span, 0, 1) * (count - 1)
        whole = np.minimum(np.floor(along), np.maximum(count - 2, 0)).astype(np.int64)
        before = first + whole
        return before, np.minimum(before + 1, first + count - 1), (along - whole).astype(np.float32)

    def at(self, time, rows=slice(None)) -> tuple[np.ndarray, np.ndarray]:
        """Places (…,3) and unit quaternions (…,4) of the paths `rows` at a model time; both as in `segment`."""
        a, b, part = self.segment(time, rows)
        part = part[:, None]
        place = self.place[a] + part * (self.place[b] - self.place[a])
        turn = self.rotation[a] + part * (self.rotation[b] - self.rotation[a])
        return place, turn / np.linalg.norm(turn, axis=1, keepdims=True)

    def there(self, time: float) -> np.ndarray:
        """(P,) bool: whether what rides on a path is there at a model time."""
        return (time >= self.start - WINDOW_SLACK) & (time <= self.end + WINDOW_SLACK)

    def __getitem__(self, rows: np.ndarray) -> Paths:
        """The paths of these indices or this mask."""
        rows = np.arange(len(self))[rows]
        count = self.count[rows]
        knots = np.repeat(self.first[rows] - (np.cumsum(count) - count), count) + np.arange(count.sum())
        return Paths(self.start[rows], self.end[rows], count, self.place[knots], self.rotation[knots])


def continuous(rotation: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Knots' quaternions (M,4), as many of each path as `count` (P,) says, with the sign that leads from each knot to
    the next by the shorter turn; the first knot of each path keeps its own."""
    agree = np.where((rotation[1:] * rotation[:-1]).sum(1) < 0, -1, 1)
    sign = np.cumprod(np.concatenate([[1], agree])).astype(rotation.dtype)
    return rotation * (sign * np.repeat(sign[np.cumsum(count) - count], count))[:, None]


def multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Quaternions (…,4) w x y z -> their product: the rotation first by b, then by a."""
    aw, ax, ay, az = np.moveaxis(a, -1, 0)
    bw, bx, by, bz = np.moveaxis(b, -1, 0)
    rows = [
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    ]
    return np.stack(rows, -1)


def rotate(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """v (…,3) turned by the unit quaternions q (…,4)."""
    u = q[..., 1:]
    t = 2 * np.cross(u, v)
    return v + q[..., :1] * t + np.cross(u, t)


def inverse(q: np.ndarray) -> np.ndarray:
    """Of unit quaternions (…,4)."""
    return q * np.array([1, -1, -1, -1], q.dtype)
