# SPDX-License-Identifier: GPL-3.0-or-later
"""When points that were followed are there: while it is sure where they are, and on from there where nothing better is
known of the surface.
"""

from __future__ import annotations

import numba
import numpy as np

BUCKETS = 1 << 16  # of the hash table of each frame's places


@numba.njit(cache=True, nogil=True)
def fill_gaps(position, sure, most, near):
    """position (N,F,3), sure (N,2) first and last frame at which each point is sure to be there, most (N,2) those to
    which it may be prolonged: makes sure longer, frame by frame, where no other point is within `near`."""
    n, frames = position.shape[:2]
    head, following = np.full((frames, BUCKETS), -1, np.int32), np.full((frames, n), -1, np.int32)
    for i in range(n):
        for g in range(sure[i, 0], sure[i, 1] + 1):
            _insert(position, i, g, near, head, following)
    growing = np.ones((n, 2), np.bool_)
    for _ in range(frames):
        for side in range(2):
            for i in range(n):
                g = sure[i, side] + 2 * side - 1
                if not growing[i, side] or g < most[i, 0] or g > most[i, 1]:
                    continue
                if _taken(position, i, g, near, head, following):
                    growing[i, side] = False
                else:
                    sure[i, side] = g
                    _insert(position, i, g, near, head, following)


@numba.njit(cache=True)
def _bucket(x, y, z):
    return (x * 73856093 ^ y * 19349663 ^ z * 83492791) & (BUCKETS - 1)


@numba.njit(cache=True)
def _insert(position, i, g, near, head, following):
    p = position[i, g]
    b = _bucket(int(np.floor(p[0] / near)), int(np.floor(p[1] / near)), int(np.floor(p[2] / near)))
    following[g, i] = head[g, b]
    head[g, b] = i


@numba.njit(cache=True)
def _taken(position, i, g, near, head, following):
    """Whether a point of the table of frame g is within `near` of point i."""
    p = position[i, g]
    x, y, z = int(np.floor(p[0] / near)), int(np.floor(p[1] / near)), int(np.floor(p[2] / near))
    for a in range(x - 1, x + 2):
        for b in range(y - 1, y + 2):
            for c in range(z - 1, z + 2):
                j = head[g, _bucket(a, b, c)]
                while j >= 0:
                    q = position[j, g]
                    if (p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2 + (p[2] - q[2]) ** 2 < near * near:
                        return True
                    j = following[g, j]
    return False
