# SPDX-License-Identifier: GPL-3.0-or-later
"""What views with depth and motion vectors say of a point that may be on the surface they show, as kernels take it."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
import torch

from ..rotations import quaternion_from_matrix
from ..views import Views
from .lift import surface_seen

# (numba's cache does not see another file change: where tracking.py is changed, this file must be touched.)
from .tracking import flow_at, known_motion

UNKNOWN, FREE = -1, -2  # pixels that say nothing, and that show that there is nothing
SHEET = 0.5  # pixels across the surface by which a point that is seen from behind may be off


class Surface(NamedTuple):
    """What the views show, as the kernels take it: n pixels."""

    frame: np.ndarray  # (V,) int64, of the clip
    centre: np.ndarray  # (V,3) of the camera, world
    w2c: np.ndarray  # (V,4,4)
    intrinsics: np.ndarray  # (V,4) fx fy cx cy
    row: np.ndarray  # (V,H,W) int32: the row of what a pixel shows, UNKNOWN or FREE
    place: np.ndarray  # (n,3) world
    normal: np.ndarray  # (n,3) towards the camera
    pixel: np.ndarray  # (n,) size of a pixel there
    constraint: np.ndarray  # (n,2,8) see `satisfy`: of the motion to the previous frame, and to the next
    turn: np.ndarray  # (n,4) quaternion, z is the normal


def surface_of(views: Views) -> tuple[Surface, np.ndarray]:
    """What the views show, and the scene flow (intervals,G,G,G,6)."""
    seen = surface_seen(views)
    field, constraint = known_motion(views, seen.points)
    row = torch.where(torch.isinf(seen.observed), FREE, UNKNOWN).int()
    row[seen.valid] = torch.arange(len(seen.points.view), dtype=torch.int32)
    frame = ((views.time + 1) / views.frame_step).round().long()
    points = seen.points
    arrays = (
        *(frame, views.c2w[:, :3, 3], torch.linalg.inv(views.c2w), views.intrinsics, row, points.place, points.normal),
        *(points.pixel, constraint, quaternion_from_matrix(seen.axes)),
    )
    return Surface(*(np.ascontiguousarray(x.numpy()) for x in arrays)), field


@numba.njit(cache=True, fastmath=True)
def pixel_at(p, j, surface):
    """The pixel (u, v) of view j that shows p (3), and its depth; depth 0 outside of the image."""
    w2c, K = surface.w2c[j], surface.intrinsics[j]
    depth = w2c[2, 0] * p[0] + w2c[2, 1] * p[1] + w2c[2, 2] * p[2] + w2c[2, 3]
    if depth < 0.01:
        return 0, 0, np.float32(0)
    right = w2c[0, 0] * p[0] + w2c[0, 1] * p[1] + w2c[0, 2] * p[2] + w2c[0, 3]
    down = w2c[1, 0] * p[0] + w2c[1, 1] * p[1] + w2c[1, 2] * p[2] + w2c[1, 3]
    u = int(np.floor(right / depth * K[0] + K[2]))
    v = int(np.floor(down / depth * K[1] + K[3]))
    if u < 0 or v < 0 or u >= surface.row.shape[2] or v >= surface.row.shape[1]:
        return 0, 0, np.float32(0)
    return u, v, depth


@numba.njit(cache=True, fastmath=True)
def off(p, r, surface):
    """How far p (3) is from what row r shows: across its surface (signed, towards the camera), and along it."""
    across, square = np.float32(0), np.float32(0)
    for k in range(3):
        away = p[k] - surface.place[r, k]
        across += surface.normal[r, k] * away
        square += away * away
    return across, np.sqrt(max(square - across * across, np.float32(0)))


@numba.njit(cache=True, nogil=True, fastmath=True)
def seen_at(p, normal, j, tolerance, surface):
    """The row of what view j shows at p (3) if it shows the point itself, UNKNOWN if it does not, FREE if it sees
    through it."""
    u, v, depth = pixel_at(p, j, surface)
    if depth == 0:
        return UNKNOWN
    height, width = surface.row.shape[1:]
    found, least, behind = UNKNOWN, np.float32(1e9), True
    for y in range(max(v - 1, 0), min(v + 2, height)):
        for x in range(max(u - 1, 0), min(u + 2, width)):
            r = surface.row[j, y, x]
            if r == FREE:
                continue
            if r == UNKNOWN:
                behind = False
                continue
            size = surface.pixel[r]
            across, along = off(p, r, surface)
            most = tolerance if _cosine(normal, r, surface) > 0 else SHEET
            if across < most * size:
                behind = False
            here = x == u and y == v
            if abs(across) < most * size and (here or along < 2 * size):
                score = abs(across) + along - (size if here else 0)
                if score < least:
                    found, least = r, score
    return FREE if behind else found


@numba.njit(cache=True, fastmath=True)
def gather(r, weight, side, sign, interval, surface, field, m, flow, rows):
    """Adds to rows (9), the lower triangle of the normal equations of what the scene flow lacks and their right side,
    what the motion vector of row r says, to the next frame (side 1) or the previous one (0); sign: 1 if they are of a
    motion to the next frame, -1 to the previous. m (6) and flow (3) are written over."""
    turned = np.float32(2 * side - 1)  # the way of the motion vector
    flow_at(field, interval, surface.place[r], m, flow)
    A = surface.constraint[r, side]
    for i in range(2):
        b = turned * A[6 + i]
        for k in range(3):
            b -= A[3 * i + k] * flow[k]
        q = 0
        for k in range(3):
            w = weight * A[3 * i + k]
            for n in range(k + 1):
                rows[q] += w * A[3 * i + n]
                q += 1
            rows[6 + k] += w * sign * b


@numba.njit(cache=True, fastmath=True)
def solve(rows, prior, out):
    """out (3) of the normal equations rows (9), with `prior` on the diagonal."""
    a, b, c, d, e, f = rows[0] + prior, rows[1], rows[2] + prior, rows[3], rows[4], rows[5] + prior
    aa, bb, cc, dd, ee, ff = c * f - e * e, d * e - b * f, a * f - d * d, b * e - c * d, b * d - a * e, a * c - b * b
    det = a * aa + b * bb + d * dd
    x, y, z = rows[6], rows[7], rows[8]
    out[0] = (aa * x + bb * y + dd * z) / det
    out[1] = (bb * x + cc * y + ee * z) / det
    out[2] = (dd * x + ee * y + ff * z) / det


@numba.njit(cache=True, fastmath=True)
def _cosine(normal, r, surface):
    n = surface.normal[r]
    return normal[0] * n[0] + normal[1] * n[1] + normal[2] * n[2]


@numba.njit(cache=True, fastmath=True)
def weight_of(p, normal, r, surface):
    """How much a point p (3) with its normal (3) is to be taken for what row r shows, 0..1."""
    across, along = off(p, r, surface)
    cosine, size = _cosine(normal, r, surface), surface.pixel[r]
    return np.exp(-((2 * across / size) ** 2) - (along / size) ** 2) * max(abs(cosine), np.float32(0.1)) ** 2


@numba.njit(cache=True, fastmath=True)
def turn(q, w):
    """Turns the quaternion q (4) by the small rotation vector w (3), in place."""
    a, x, y, z = q[0], q[1], q[2], q[3]
    h0, h1, h2 = 0.5 * w[0], 0.5 * w[1], 0.5 * w[2]
    q[0] = a - h0 * x - h1 * y - h2 * z
    q[1] = x + h0 * a + h1 * z - h2 * y
    q[2] = y + h1 * a + h2 * x - h0 * z
    q[3] = z + h2 * a + h0 * y - h1 * x
    length = np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    for k in range(4):
        q[k] /= length


@numba.njit(cache=True, fastmath=True)
def third_axis(q, out):
    """out (3): the third axis of the quaternion q (4)."""
    out[0] = 2 * (q[1] * q[3] + q[0] * q[2])
    out[1] = 2 * (q[2] * q[3] - q[0] * q[1])
    out[2] = 1 - 2 * (q[1] * q[1] + q[2] * q[2])


@numba.njit(cache=True, fastmath=True)
def gather_depth(p, r, weight, more, surface, rows):
    """Adds to rows (9), see `gather`, that p (3), where `more` (3) brought it, is to be on the surface of row r."""
    across, _ = off(p, r, surface)
    n = surface.normal[r]
    b = -across
    for k in range(3):
        b += n[k] * more[k]
    q = 0
    for k in range(3):
        for i in range(k + 1):
            rows[q] += weight * n[k] * n[i]
            q += 1
        rows[6 + k] += weight * n[k] * b


@numba.njit(cache=True, fastmath=True)
def lean(q, normal, r, part, surface):
    """Turns q (4), whose third axis is normal (3), by a part of the way to the normal of row r, or to its opposite."""
    n, w = surface.normal[r], np.empty(3, np.float32)
    if _cosine(normal, r, surface) < 0:
        part = -part
    for k in range(3):
        a, b = (k + 1) % 3, (k + 2) % 3
        w[k] = part * (normal[a] * n[b] - normal[b] * n[a])
    turn(q, w)
