# SPDX-License-Identifier: GPL-3.0-or-later
"""Scene flow from motion vectors: how every place of the scene moves, from each frame of the clip to its next.

A motion vector constrains two of the three components of a point's motion. All that the views say about one
frame interval is gathered in a voxel grid as small least-squares problems for a rigid motion each; views from
different sides complete each other, coarser levels fill in where nothing was seen (the far side of a leg moves
like its near side).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np
import torch
from torch import Tensor

from ..parallel import parallel_for
from ..views import Views

GRID = 24  # voxels of the flow along [-EXTENT, EXTENT]
EXTENT = 1.15
FAR_INTERVALS = (0.02, 5e-3, 1e-3)  # weight of what is known one to three intervals away: motion changes between frames


class FlowSettings(NamedTuple):
    """Weights of the least squares of the scene flow."""

    coarse: float = 5e-2  # of the four times coarser level that fills in where nothing was seen
    coarsest: float = 1e-5  # of one motion for all voxels
    still: float = 1e-3  # pull of a voxel's motion towards none, as a multiple of what is known
    unturned: float = 1e-3  # pull of its turn towards none, the same


FLOW = FlowSettings()


@dataclass
class SurfacePoints:
    """The n surface points that V views see, in the order of their views."""

    view: Tensor  # (n,) index of the view
    place: Tensor  # (n,3) world
    normal: Tensor  # (n,3) unit, world, towards the camera
    pixel: Tensor  # (n,) size of a pixel at the surface, normalised units
    to_next: Tensor  # (n,2) motion vectors to the next frame and to the previous one, in pixels
    to_previous: Tensor
    depth: Tensor  # (n,) planar z
    ray: Tensor  # (n,2) x/z and y/z in the camera


class _FlowEquations(NamedTuple):
    """What n points say about the motion of their voxels, as the kernel takes it."""

    frame: np.ndarray  # (n,) int64, of the clip
    cell: np.ndarray  # (n,) int64, voxel
    B: np.ndarray  # (n,2,6) B·(v,ω) = b
    next_b: np.ndarray  # (n,2)
    previous_b: np.ndarray  # (n,2)


def constraints(views: Views, points: SurfacePoints) -> tuple[Tensor, Tensor, Tensor]:
    """-> A (n,2,3), and b (n,2) of the motion to the next frame and of that to the previous one: A·motion = b for the
    motion (n,3) in the world, exact in perspective."""
    R = views.c2w[:, :3, :3][points.view]
    A = R[:, :, :2].mT - points.ray[..., None] * R[:, None, :, 2]
    size = points.depth[:, None] / views.intrinsics[points.view, :2]
    return A, points.to_next * size, points.to_previous * size


def scene_flow(
    views: Views,
    points: SurfacePoints,
    A: Tensor,
    next_b: Tensor,
    previous_b: Tensor,
    intervals: int,
    settings: FlowSettings = FLOW,
) -> Tensor:
    """A (n,2,3), next_b and previous_b (n,2) of `constraints` -> (intervals, G, G, G, 6) motion from each frame of
    the clip to its next, on voxels over [-EXTENT, EXTENT]³ (indices x, y, z): v and ω, by which a point p of the
    voxel moves by v + ω x p."""
    field = np.zeros((intervals, GRID, GRID, GRID, 6), np.float32)
    if not (next_b.any() or previous_b.any()):  # no motion anywhere (the sweep knows none): zero solves it
        return torch.from_numpy(field)
    frame = ((views.time + 1) / views.frame_step).round().long()[points.view].numpy()
    B = torch.cat([A, torch.linalg.cross(points.place[:, None].expand_as(A), A)], -1)  # motion = v + ω x place
    cell = ((points.place / EXTENT + 1) * (0.5 * GRID)).long().clamp(0, GRID - 1)
    cell = (cell[:, 0] * GRID + cell[:, 1]) * GRID + cell[:, 2]
    equations = _FlowEquations(frame, *(x.contiguous().numpy() for x in (cell, B, next_b, previous_b)))
    near_in_time = np.array([1, *FAR_INTERVALS], np.float32)
    known = (equations, near_in_time, single(settings), field)
    parallel_for([(t,) for t in range(intervals)], lambda t: _solve_interval(t, *known))
    return torch.from_numpy(field)


def single(settings: NamedTuple) -> NamedTuple:
    """The same in single precision, which is what kernels compute in."""
    return type(settings)(*map(np.float32, settings))


@numba.njit(cache=True, nogil=True, fastmath=True)
def _solve_interval(t, equations, near_in_time, weights, out):
    """Writes the motion of interval t to out (T,G,G,G,6): least squares of B·(v,ω) = b over the points of each
    voxel, joined with those of neighbours in space and, weighted by near_in_time (K), of K - 1 intervals to either
    side."""
    frame, cell, B = equations.frame, equations.cell, equations.B
    next_b, previous_b = equations.next_b, equations.previous_b
    G = out.shape[1]
    Q = G // 4
    near = np.zeros((G, G, G, 27), np.float32)  # lower triangles of BᵀB, then Bᵀb
    flat = near.reshape(-1, 27)
    for i in range(len(frame)):
        for before in range(2):
            away = abs(frame[i] - before - t)
            if away >= len(near_in_time) or not 0 <= frame[i] - before < len(out):
                continue
            for r in range(2):
                b = -previous_b[i, r] if before else next_b[i, r]
                q = 0
                for j in range(6):
                    w = near_in_time[away] * B[i, r, j]
                    for k in range(j + 1):
                        flat[cell[i], q] += w * B[i, r, k]
                        q += 1
                    flat[cell[i], 21 + j] += w * b
    coarse = np.zeros((Q, Q, Q, 27), np.float32)
    whole = np.zeros(27, np.float32)
    for x in range(G):
        for y in range(G):
            for z in range(G):
                for c in range(27):
                    coarse[x // 4, y // 4, z // 4, c] += near[x, y, z, c] / 64
                    whole[c] += near[x, y, z, c] / (G * G * G)
    _blur(coarse)
    _blur(near)
    rows, rest = np.empty(27, np.float64), np.empty(6, np.float32)
    for u in range(Q**3):
        X, Y, Z = 4 * (u // (Q * Q)), 4 * (u // Q % Q), 4 * (u % Q)
        for c in range(27):
            rows[c] = weights.coarse * coarse[X // 4, Y // 4, Z // 4, c] + weights.coarsest * whole[c]
        _solve_voxel(rows, X + 1.5, Y + 1.5, Z + 1.5, weights, rest)
        for x in range(X, X + 4):
            for y in range(Y, Y + 4):
                for z in range(Z, Z + 4):
                    if near[x, y, z, 0] + near[x, y, z, 2] + near[x, y, z, 5] == 0:  # nothing seen here
                        out[t, x, y, z] = rest
                        continue
                    for c in range(27):
                        rows[c] = near[x, y, z, c] + weights.coarse * coarse[X // 4, Y // 4, Z // 4, c]
                        rows[c] += weights.coarsest * whole[c]
                    _solve_voxel(rows, x, y, z, weights, out[t, x, y, z])


@numba.njit(cache=True, fastmath=True)
def _blur(x):
    """Blurs (n,n,n,C) by the triangle 1 2 1 along each axis, zero outside; in place."""
    n, C = x.shape[0], x.shape[3]
    flat = x.reshape(-1)
    line = np.zeros((n + 2, C), np.float32)
    for axis in range(3):
        below = n ** (2 - axis)  # voxels that follow while this axis stands still
        stride = C * below
        for number in range(n * n):
            first = (number // below) * n * stride + (number % below) * C
            for k in range(n):
                for c in range(C):
                    line[k + 1, c] = flat[first + k * stride + c]
            for k in range(n):
                for c in range(C):
                    flat[first + k * stride + c] = (line[k, c] + 2 * line[k + 1, c] + line[k + 2, c]) / 4


@numba.njit(cache=True, fastmath=True)
def _solve_voxel(rows, x, y, z, weights, out):
    """Lower triangle and right-hand side (27) of the normal equations of voxel x, y, z -> out (6), by Cholesky's
    decomposition. Small multiples of the trace keep what nothing constrains at zero: the voxel's middle c moves by
    v + ω x c, and turns by ω."""
    trace = rows[0] + rows[2] + rows[5]
    if trace < 1e-12:
        out[:] = 0
        return
    G = GRID
    c = np.array([(2 * x + 1) / G - 1, (2 * y + 1) / G - 1, (2 * z + 1) / G - 1]) * EXTENT
    at_middle = np.zeros((3, 6))
    for k in range(3):
        at_middle[k, k] = 1
        at_middle[k, 3 + (k + 1) % 3] = c[(k + 2) % 3]
        at_middle[k, 3 + (k + 2) % 3] = -c[(k + 1) % 3]
    N, b = np.empty((6, 6)), rows[21:]
    q = 0
    for i in range(6):
        for j in range(i + 1):
            N[i, j] = rows[q] + (weights.unturned * trace if i == j and i > 2 else 0)
            for k in range(3):
                N[i, j] += weights.still * trace * at_middle[k, i] * at_middle[k, j]
            for k in range(j):
                N[i, j] -= N[i, k] * N[j, k]
            N[i, j] = np.sqrt(N[i, j]) if i == j else N[i, j] / N[j, j]
            q += 1
    for i in range(6):
        for k in range(i):
            b[i] -= N[i, k] * b[k]
        b[i] /= N[i, i]
    for i in range(5, -1, -1):
        for k in range(i + 1, 6):
            b[i] -= N[k, i] * b[k]
        b[i] /= N[i, i]
        out[i] = b[i]
