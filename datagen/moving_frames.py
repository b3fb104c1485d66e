# SPDX-License-Identifier: GPL-3.0-or-later
"""Frames of reference that turn with a surface, from its triangles at each frame of a clip. numpy only."""

from __future__ import annotations

import numpy as np


def moving_frames(corners: np.ndarray) -> np.ndarray:
    """(F,N,4) float64 unit quaternions w x y z of the frames of triangles (F,N,3,3): x along the first edge, z the
    normal. A segment, its second corner twice, has x along it and turns no more than it must. Each quaternion lies near
    the one before; where a triangle has no area it stays as it was."""
    quaternions = np.empty((*corners.shape[:2], 4))
    turn = _first_frames(corners)
    segment = (corners[:, :, 1] == corners[:, :, 2]).all((0, 2))
    for f in range(len(corners)):
        frame, there = triangle_frames(corners[f])
        turn = np.where(there[:, None, None], frame, turn)
        if segment.any():
            x, long = _unit(corners[f, :, 1] - corners[f, :, 0])
            along = segment & long
            turn[along] = _least_rotation(turn[along, :, 0], x[along]) @ turn[along]
        q = _quaternions(turn)
        quaternions[f] = q if f == 0 else np.where((q * quaternions[f - 1]).sum(-1, keepdims=True) < 0, -q, q)
    return quaternions


def triangle_frames(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation matrices (N,3,3) of triangles (N,3,3), and which (N,) of them have an area."""
    a, b, c = corners.transpose(1, 0, 2)
    x, long = _unit(b - a)
    z, wide = _unit(np.cross(x, c - a))
    return np.stack([x, np.cross(z, x), z], -1), long & wide


def _first_frames(corners: np.ndarray) -> np.ndarray:
    """(N,3,3) the first frame of each of the triangles (F,N,3,3); identity for those that never have an area."""
    turn = np.tile(np.eye(3), (corners.shape[1], 1, 1))
    missing = np.arange(corners.shape[1])
    for at in corners:
        frame, there = triangle_frames(at[missing])
        turn[missing[there]] = frame[there]
        missing = missing[~there]
        if not len(missing):
            break
    return turn


def _unit(v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vectors (N,3) made of length 1, and which (N,) have a length beyond the noise of normalised float32."""
    length = np.linalg.norm(v, axis=-1)
    return v / np.maximum(length, 1e-30)[:, None], length > 1e-6


def _least_rotation(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(N,3,3) that turn unit vectors a to b the shortest way; half a turn, about any axis across, where they are
    opposite."""
    opposite = (a * b).sum(-1) < -1 + 1e-9
    across, _ = _unit(np.cross(a, np.eye(3)[np.abs(a).argmin(-1)]))
    between, _ = _unit(a + b)

    def half_turn(about: np.ndarray) -> np.ndarray:
        return 2 * about[:, :, None] * about[:, None, :] - np.eye(3)

    # The half turn about a leaves it there, that about what lies between takes it to b; together they turn across both.
    return np.where(opposite[:, None, None], half_turn(across), half_turn(between) @ half_turn(a))


def _quaternions(turn: np.ndarray) -> np.ndarray:
    """Rotation matrices (N,3,3) -> unit quaternions (N,4) w x y z, by the largest of the four."""
    m = turn
    xx, yy, zz = m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]
    squares = np.stack([1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz], 1)  # times 4
    wx, wy, wz = m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]
    xy, xz, yz = m[:, 1, 0] + m[:, 0, 1], m[:, 0, 2] + m[:, 2, 0], m[:, 2, 1] + m[:, 1, 2]
    w, x, y, z = squares.T
    rows = np.stack([w, wx, wy, wz, wx, x, xy, xz, wy, xy, y, yz, wz, xz, yz, z], 1).reshape(-1, 4, 4)
    q = rows[np.arange(len(rows)), squares.argmax(1)]
    return q / np.linalg.norm(q, axis=1, keepdims=True)
