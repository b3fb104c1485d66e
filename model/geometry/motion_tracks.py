# SPDX-License-Identifier: GPL-3.0-or-later
"""Surface points followed through the whole clip from depth and motion vectors, where no mesh is known.

What a pixel shows and no point explains becomes a new point. It goes along the scene flow from frame to frame, both
ways, and is put right wherever a view sees it: its motion by the pixel's own motion vector, its depth by the depth map.
It ends where a view sees through it.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
import torch

from ...datagen.track_file import SurfaceTracks
from ..parallel import chunks, parallel_for
from ..rotations import quaternion_from_matrix
from ..views import Views
from .lift import surface_seen
from .scene_flow import single

# (numba's cache does not see another file change: where tracking.py or EXTENT is changed, this file must be touched.)
from .tracking import flow_at, known_motion

UNKNOWN, FREE = -1, -2  # pixels that say nothing, and that show that there is nothing


class MotionSettings(NamedTuple):
    """How points are sown and followed; distances in pixel sizes."""

    apart: float = 0.9  # points that pixels beside one another start are at least so far apart
    near: float = 1.3  # a pixel is explained by a point so near along the surface …
    deep: float = 2.0  # … and so near across it
    tolerance: float = 1.3  # across the surface, by which a point that is seen may be off, plus …
    drift: float = 0.3  # … this for each frame since it was last seen, …
    most: float = 3.0  # … up to this
    sheet: float = 0.5  # the same for a surface seen from behind
    steepest: float = 0.2  # cosine: pixels that see the surface under less start no points
    unseen: int = 24  # frames that a point is followed without being seen
    prior: float = 0.03  # weight of the scene flow against what motion vectors say of a point's own step
    depth: float = 4.0  # weight of the depth of what is seen, as a multiple of that of its motion
    turn: float = 0.3  # share by which a normal that is seen turns the point's


MOTION = MotionSettings()


class _Surface(NamedTuple):
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


class _Points(NamedTuple):
    """N points followed through F frames, as in SurfaceTracks but float32."""

    position: np.ndarray  # (N,F,3)
    rotation: np.ndarray  # (N,F,4)
    first: np.ndarray  # (N,)
    last: np.ndarray  # (N,)
    area: np.ndarray  # (N,)


def motion_tracks(
    views: Views, known: SurfaceTracks | None = None, settings: MotionSettings = MOTION
) -> SurfaceTracks:
    """Points of what the views with depth and flow show, beside the `known` ones, which explain pixels but are not
    returned. CPU tensors."""
    frames = 1 if views.frame_step == 2 and not views.time.any() else round(2 / views.frame_step) + 1
    surface, field = _surface(views)
    rules = single(settings)
    there = [] if known is None else [_Points(known.position, known.rotation, known.first, known.last, known.area)]
    found: list[_Points] = []
    for f in _order(frames):
        new = _sown(surface, f, frames, [*there, *found], rules)
        jobs = chunks(len(new.first), 1024)
        parallel_for(jobs, lambda a, b, new=new, f=f: _follow(a, b, f, surface, field, rules, *new[:4]))
        found.append(new)
    points = _Points(*map(np.concatenate, zip(*found, strict=True)))
    return SurfaceTracks(
        points.position,
        points.rotation.astype(np.float16),
        points.first.astype(np.int32),
        points.last.astype(np.int32),
        points.area,
    )


def _order(frames: int) -> list[int]:
    """Frames 0…frames - 1, from the middle on ever finer."""
    found: dict[int, None] = {}
    parts = 1
    while len(found) < frames:
        for k in range(parts):
            found.setdefault((2 * k + 1) * frames // (2 * parts))
        parts *= 2
    return list(found)


def _surface(views: Views) -> tuple[_Surface, np.ndarray]:
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
    return _Surface(*(np.ascontiguousarray(x.numpy()) for x in arrays)), field


def _sown(surface: _Surface, f: int, frames: int, points: list[_Points], rules: MotionSettings) -> _Points:
    """The points that pixels of frame f start which none of `points` explains; they are at frame f alone."""
    random = np.random.default_rng(f)
    started: list[np.ndarray] = []  # rows
    for v in np.flatnonzero(surface.frame == f):
        explained = np.zeros(surface.row.shape[1:], np.bool_)
        for p in points:
            alive = (p.first <= f) & (f <= p.last)
            _explain(p.position[alive, f], v, surface, explained, rules.near, rules.deep)
        for rows in started:
            _explain(surface.place[rows], v, surface, explained, rules.near, rules.deep)
        left = np.flatnonzero(~explained & (surface.row[v] >= 0))
        started.append(_thinned(random.permutation(left), v, surface, explained, rules))
    rows = np.concatenate(started) if started else np.zeros(0, np.int64)
    n = len(rows)
    position, rotation = np.zeros((n, frames, 3), np.float32), np.zeros((n, frames, 4), np.float32)
    position[:], rotation[:] = surface.place[rows, None], surface.turn[rows, None]
    when = np.full(n, f)
    return _Points(position, rotation, when, when.copy(), (rules.apart * surface.pixel[rows]) ** 2 * np.float32(1.4))


@numba.njit(cache=True, fastmath=True)
def _pixel(p, j, surface):
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
def _off(p, r, surface):
    """How far p (3) is from what row r shows: across its surface (signed, towards the camera), and along it."""
    across, square = np.float32(0), np.float32(0)
    for k in range(3):
        away = p[k] - surface.place[r, k]
        across += surface.normal[r, k] * away
        square += away * away
    return across, np.sqrt(max(square - across * across, np.float32(0)))


@numba.njit(cache=True, nogil=True, fastmath=True)
def _explain(places, j, surface, explained, near, deep):
    """Marks in explained (H,W) the pixels of view j that the places (n,3) explain."""
    height, width = explained.shape
    for i in range(len(places)):
        u, v, depth = _pixel(places[i], j, surface)
        if depth == 0:
            continue
        for y in range(max(v - 1, 0), min(v + 2, height)):
            for x in range(max(u - 1, 0), min(u + 2, width)):
                r = surface.row[j, y, x]
                if r >= 0 and not explained[y, x]:
                    across, along = _off(places[i], r, surface)
                    size = surface.pixel[r]
                    explained[y, x] = abs(across) < deep * size and along < near * size


@numba.njit(cache=True, nogil=True, fastmath=True)
def _thinned(pixels, j, surface, explained, rules):
    """Of pixels (n,) of view j, as y * W + x, the rows of those that are `apart` from one another."""
    width = explained.shape[1]
    rows, count = np.empty(len(pixels), np.int64), 0
    for i in range(len(pixels)):
        y, x = pixels[i] // width, pixels[i] % width
        if explained[y, x]:
            continue
        r = surface.row[j, y, x]
        cosine, square = np.float32(0), np.float32(0)
        for k in range(3):
            away = surface.centre[j, k] - surface.place[r, k]
            cosine += surface.normal[r, k] * away
            square += away * away
        if cosine < rules.steepest * np.sqrt(square):
            continue
        rows[count] = r
        _explain(surface.place[r : r + 1], j, surface, explained, rules.apart, rules.deep)
        count += 1
    return rows[:count]


@numba.njit(cache=True, nogil=True, fastmath=True)
def _seen_at(p, normal, j, tolerance, surface, rules):
    """The row of what view j shows at p (3) if it shows the point itself, UNKNOWN if it does not, FREE if it sees
    through it."""
    u, v, depth = _pixel(p, j, surface)
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
            across, along = _off(p, r, surface)
            cosine = np.float32(0)
            for k in range(3):
                cosine += normal[k] * surface.normal[r, k]
            most = tolerance if cosine > 0 else rules.sheet
            if across < most * size:
                behind = False
            here = x == u and y == v
            if abs(across) < most * size and (here or along < 2 * size):
                score = abs(across) + along - (size if here else 0)
                if score < least:
                    found, least = r, score
    return FREE if behind else found


@numba.njit(cache=True, fastmath=True)
def _gather(p, r, weight, side, sign, interval, surface, field, m, flow, rows):
    """Adds to rows (9), the lower triangle of the normal equations of what the scene flow lacks at p (3) and their right
    side, what the motion vector of row r says, to the next frame (side 1) or the previous one (0); sign: 1 if they are
    of a motion to the next frame, -1 to the previous. m (6) and flow (3) are written over."""
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
def _solve(rows, prior, out):
    """out (3) of the normal equations rows (9), with `prior` on the diagonal."""
    a, b, c, d, e, f = rows[0] + prior, rows[1], rows[2] + prior, rows[3], rows[4], rows[5] + prior
    aa, bb, cc, dd, ee, ff = c * f - e * e, d * e - b * f, a * f - d * d, b * e - c * d, b * d - a * e, a * c - b * b
    det = a * aa + b * bb + d * dd
    x, y, z = rows[6], rows[7], rows[8]
    out[0] = (aa * x + bb * y + dd * z) / det
    out[1] = (bb * x + cc * y + ee * z) / det
    out[2] = (dd * x + ee * y + ff * z) / det


@numba.njit(cache=True, fastmath=True)
def _weight(p, normal, r, surface):
    """How much a point p (3) with its normal (3) is to be taken for what row r shows, 0..1."""
    across, along = _off(p, r, surface)
    cosine = np.float32(0)
    for k in range(3):
        cosine += normal[k] * surface.normal[r, k]
    size = surface.pixel[r]
    return np.exp(-((2 * across / size) ** 2) - (along / size) ** 2) * max(abs(cosine), np.float32(0.1)) ** 2


@numba.njit(cache=True, fastmath=True)
def _turned(q, w):
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
def _normal(q, out):
    """out (3): the third axis of the quaternion q (4)."""
    out[0] = 2 * (q[1] * q[3] + q[0] * q[2])
    out[1] = 2 * (q[2] * q[3] - q[0] * q[1])
    out[2] = 1 - 2 * (q[1] * q[1] + q[2] * q[2])


@numba.njit(cache=True, nogil=True, fastmath=True)
def _follow(begin, end, here, surface, field, rules, position, rotation, first, last):
    """Follows the points begin…end from frame `here` both ways."""
    frames = position.shape[1]
    for i in range(begin, end):
        for side in range(2):
            f = _follow_one(here, side, surface, field, rules, position[i], rotation[i])
            if side:
                last[i] = f
            else:
                first[i] = f
            for g in range(f + 1, frames) if side else range(f):
                position[i, g], rotation[i, g] = position[i, f], rotation[i, f]


@numba.njit(cache=True, nogil=True, fastmath=True)
def _follow_one(here, side, surface, field, rules, position, rotation):
    """Follows a point with position (F,3) and rotation (F,4) from frame `here` on, to later ones (side 1) or earlier
    ones (0) -> the frame at which it is there last."""
    frames, direction = len(position), 2 * side - 1
    start, p, q = position[here].copy(), position[here].copy(), rotation[here].copy()
    flow, more, other, normal = np.empty(3, np.float32), np.empty(3, np.float32), p.copy(), np.empty(3, np.float32)
    m, spin, rows = np.empty(6, np.float32), np.empty(3, np.float32), np.empty(9, np.float32)
    confirmed, f = here, here
    size = np.float32(0)
    while 0 <= f + direction < frames:
        g, interval = f + direction, (f if side else f - 1)
        start[:] = p
        _normal(q, normal)
        flow_at(field, interval, p, m, flow)
        for k in range(3):
            flow[k] *= direction
            spin[k] = direction * m[3 + k]
        rows[:] = 0
        more[:] = 0
        tolerance = min(rules.tolerance + rules.drift * abs(f - confirmed), rules.most)
        for j in range(len(surface.frame)):
            if surface.frame[j] == f:
                r = _seen_at(p, normal, j, tolerance, surface, rules)
                if r >= 0:
                    w = _weight(p, normal, r, surface)
                    _gather(p, r, w, side, direction, interval, surface, field, m, other, rows)
        _solve(rows, rules.prior, more)
        _turned(q, spin)
        _normal(q, normal)
        tolerance = min(rules.tolerance + rules.drift * abs(g - confirmed), rules.most)
        for k in range(3):
            p[k] = start[k] + flow[k] + more[k]
        for j in range(len(surface.frame)):
            if surface.frame[j] == g:
                r = _seen_at(p, normal, j, tolerance, surface, rules)
                if r >= 0:
                    w = _weight(p, normal, r, surface)
                    _gather(p, r, w, 1 - side, direction, interval, surface, field, m, other, rows)
        other[:] = p
        seen = gone = False
        for j in range(len(surface.frame)):
            if surface.frame[j] == g:
                r = _seen_at(p, normal, j, tolerance, surface, rules)
                if r == FREE:
                    gone = True
                elif r >= 0:
                    seen = True
                    w = _weight(p, normal, r, surface)
                    _gather_depth(p, r, rules.depth * w, more, surface, rows)
                    _lean(q, normal, r, rules.turn * w, surface)
        _solve(rows, rules.prior, more)
        for k in range(3):
            p[k] = start[k] + flow[k] + more[k]
        if gone or abs(g - confirmed) > rules.unseen:
            break
        position[g], rotation[g] = p, q
        if seen:
            for h in range(confirmed + direction, g, direction):
                part = np.float32(abs(h - confirmed)) / abs(g - confirmed)
                for k in range(3):
                    position[h, k] += part * (p[k] - other[k])
            confirmed = g
        f = g
    return f


@numba.njit(cache=True, fastmath=True)
def _gather_depth(p, r, weight, more, surface, rows):
    """Adds to rows (9), see `_gather`, that p (3), where `more` (3) brought it, is to be on the surface of row r."""
    across, _ = _off(p, r, surface)
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
def _lean(q, normal, r, part, surface):
    """Turns q (4), whose third axis is normal (3), by a part of the way to the normal of row r, or to its opposite."""
    n, w, cosine = surface.normal[r], np.empty(3, np.float32), np.float32(0)
    for k in range(3):
        cosine += normal[k] * n[k]
    for k in range(3):
        a, b = (k + 1) % 3, (k + 2) % 3
        w[k] = (part if cosine > 0 else -part) * (normal[a] * n[b] - normal[b] * n[a])
    _turned(q, w)
