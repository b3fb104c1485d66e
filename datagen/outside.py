# SPDX-License-Identifier: GPL-3.0-or-later
"""Which of many points on surfaces can be seen from outside. numpy only."""

from __future__ import annotations

import numpy as np

_AXES = 26  # each looked along both ways: 52 directions
_GRID = 256  # cells a side, at most
_SPACINGS = 2.5  # a cell is so many spacings of points wide, at least: an empty one in front shows what is behind
# Cells: how far behind the foremost of its cell a point of the same surface, faced nearly straight, may lie.
_TOLERANCE = 0.5


def seen_from_outside(points: np.ndarray, spacing: float) -> np.ndarray:
    """(M,) bool: which of the points (M,3), drawn evenly about `spacing` apart, some direction shows in front of all
    others. Surfaces are seen from both sides."""
    seen = np.zeros(len(points), bool)
    if not len(points):
        return seen
    low, high = points.min(0), points.max(0)
    half = float(np.linalg.norm(high - low) / 2) + 1e-9
    cell = max(2 * half / _GRID, _SPACINGS * spacing)
    side = int(2 * half / cell) + 2
    centred = (points - (low + high) / 2).astype(np.float32)
    for right, up, forward in _looks():
        where = ((centred @ np.stack([right, up], 1) + half) / cell).astype(np.int32)
        index = where[:, 0] * side + where[:, 1]
        depth = centred @ forward
        for z in (depth, -depth):
            nearest = np.full(side * side, np.inf, np.float32)
            np.minimum.at(nearest, index, z)
            seen |= z <= nearest[index] + _TOLERANCE * cell
    return seen


def _looks() -> np.ndarray:
    """(_AXES,3,3) float32: orthonormal right, up and forward of directions spread evenly over a half of the sphere."""
    k = np.arange(_AXES)
    z, turn = (k + 0.5) / _AXES, k * np.pi * (3 - np.sqrt(5))  # a Fibonacci lattice
    ring = np.sqrt(1 - z * z)
    forward = np.stack([ring * np.cos(turn), ring * np.sin(turn), z], 1)
    right = np.stack([-np.sin(turn), np.cos(turn), 0 * z], 1)
    return np.stack([right, np.cross(forward, right), forward], 1).astype(np.float32)
