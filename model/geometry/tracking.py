# SPDX-License-Identifier: GPL-3.0-or-later
"""Following surface points through time, along the scene flow.

Each pixel's point is followed both ways until a view sees the same surface well enough (its own pixel takes over),
sees through the point (it is wrong by then), or the clip ends. A track is cut into pieces that are straight to within
a fraction of a pixel: each becomes one Gaussian.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
import torch
from torch import Tensor

from ..parallel import chunks, parallel_for
from ..views import Views

# (numba's cache does not see another file change: where EXTENT is changed, this file must be touched.)
from .scene_flow import EXTENT, SurfacePoints, constraints, scene_flow, single

MAX_PIECES = 8  # per track


class TrackingSettings(NamedTuple):
    """When a point is followed no further, and how finely its track is cut."""

    tolerance: float = 1.3  # depth agreement, in pixel sizes, plus …
    drift: float = 0.5  # … this per frame of following
    max_frames: float = 8.0  # that a point is followed
    min_cosine: float = 0.15  # a view that sees a surface under a cosine above this may take over from another
    handover: float = 0.45  # a point is needed for this part of the time until another view takes over
    straightness: float = 0.5  # a piece's greatest distance from its chord, in pixel sizes


TRACKING = TrackingSettings()


class Pieces(NamedTuple):
    """Straight pieces of tracks, (M,) Tensors; in the kernel (n,MAX_PIECES) arrays of n points."""

    time: Tensor  # (M,) its middle, in frames since the clip's middle
    half_length: Tensor  # (M,) in frames
    place: Tensor  # (M,3) world, at the middle
    velocity: Tensor  # (M,3) world, per frame


class TrackSummary(NamedTuple):
    """What following said about each of n points."""

    frames_before: Tensor  # (n,) that the point is needed before its view's time
    frames_after: Tensor  # (n,)
    agreeing_views: Tensor  # (n,) how many saw the point where its track says
    contradicted: Tensor  # (n,) 1 where a view saw through it, else 0


class Tracks(NamedTuple):
    """Of n points, in M pieces."""

    pieces: Pieces
    point: Tensor  # (M,) index 0..n-1 of the point that each piece belongs to, ascending
    summary: TrackSummary


class _PointArrays(NamedTuple):
    """The points as the kernel takes them, float32 but for the view."""

    view_index: np.ndarray  # (n,) int64
    place: np.ndarray  # (n,3)
    normal: np.ndarray  # (n,3)
    pixel: np.ndarray  # (n,)
    constraint: np.ndarray  # (n,2,8) see `satisfy`: of the motion to the previous frame, and to the next


class _ViewArrays(NamedTuple):
    """The views as the kernel takes them, float32."""

    frame: np.ndarray  # (V,) since the clip's middle
    centre: np.ndarray  # (V,3) of the camera, world
    w2c: np.ndarray  # (V,4,4)
    intrinsics: np.ndarray  # (V,4) fx fy cx cy
    observed: np.ndarray  # (V,H,W) see `track_points`


def track_points(
    views: Views, points: SurfacePoints, observed: Tensor, settings: TrackingSettings = TRACKING
) -> Tracks:
    """The tracks of the n points through the clip, as straight pieces. observed (V,H,W): what each pixel shows, for
    comparison: planar z, free space (inf), or unknown (-1). CPU tensors."""
    frame = views.time / views.frame_step
    last = 1 / views.frame_step if views.frame_step < 2 else 0.0
    field, constraint = known_motion(views, points)
    own = _PointArrays(points.view.numpy(), *map(_float32, (points.place, points.normal, points.pixel, constraint)))
    cameras = (frame, views.c2w[:, :3, 3], torch.linalg.inv(views.c2w), views.intrinsics, observed)
    known = (own, _ViewArrays(*map(_float32, cameras)), field, np.float32(-last), np.float32(last))
    n = len(points.view)
    pieces = Pieces(*(np.zeros((n, MAX_PIECES, *tail), np.float32) for tail in ((), (), (3,), (3,))))
    count, summary = np.zeros(n, np.int64), TrackSummary(*np.zeros((4, n), np.float32))
    rules = single(settings)
    parallel_for(chunks(n, 4096), lambda begin, end: _tracks(begin, end, *known, rules, pieces, count, summary))
    taken = np.arange(MAX_PIECES)[None] < count[:, None]
    point = np.repeat(np.arange(n), count)
    return Tracks(
        Pieces(*(torch.from_numpy(x[taken]) for x in pieces)),
        torch.from_numpy(point),
        TrackSummary(*map(torch.from_numpy, summary)),
    )


def known_motion(views: Views, points: SurfacePoints) -> tuple[np.ndarray, Tensor]:
    """The scene flow (intervals,G,G,G,6), and what the points' own pixels say (n,2,8) as `satisfy` takes it: of the
    motion to the previous frame, and to the next."""
    last = 1 / views.frame_step if views.frame_step < 2 else 0.0
    A, next_b, previous_b = constraints(views, points)
    field = scene_flow(views, points, A, next_b, previous_b, max(round(2 * last), 1))
    return field.numpy(), torch.stack([torch.cat([A.flatten(1), b], -1) for b in (previous_b, next_b)], 1)


def _float32(x: Tensor) -> np.ndarray:
    return np.ascontiguousarray(x.numpy(), np.float32)


@numba.njit(cache=True, fastmath=True)
def _depth_error(x, y, z, j, w2c, K, observed, tolerance):
    """How view j sees a point: (depth error / tolerance, True), -inf in free space; (0, False) where it is outside
    of the image or unknown."""
    depth = w2c[j, 2, 0] * x + w2c[j, 2, 1] * y + w2c[j, 2, 2] * z + w2c[j, 2, 3]
    if depth < 0.01:
        return 0.0, False
    right = w2c[j, 0, 0] * x + w2c[j, 0, 1] * y + w2c[j, 0, 2] * z + w2c[j, 0, 3]
    down = w2c[j, 1, 0] * x + w2c[j, 1, 1] * y + w2c[j, 1, 2] * z + w2c[j, 1, 3]
    u = int(np.floor(right / depth * K[j, 0] + K[j, 2]))
    v = int(np.floor(down / depth * K[j, 1] + K[j, 3]))
    if u < 0 or v < 0 or u >= observed.shape[2] or v >= observed.shape[1] or observed[j, v, u] < 0:
        return 0.0, False
    return (depth - observed[j, v, u]) / tolerance, True


@numba.njit(cache=True, fastmath=True)
def flow_at(field, interval, p, m, out):
    """Trilinear value of the scene flow at p (3): its v and ω to m (6), the motion v + ω x p to out (3)."""
    grid = field.shape[1]
    base = np.empty(3, np.int64)
    part = np.empty(3, np.float32)
    for k in range(3):
        g = min(max((p[k] / EXTENT + 1) * 0.5 * grid - 0.5, 0.0), grid - 1.001)
        base[k] = int(g)
        part[k] = g - base[k]
    m[:] = 0
    for corner in range(8):
        a, b, c = corner & 1, (corner >> 1) & 1, corner >> 2
        w = (part[0] if a else 1 - part[0]) * (part[1] if b else 1 - part[1]) * (part[2] if c else 1 - part[2])
        for k in range(6):
            m[k] += w * field[interval, base[0] + a, base[1] + b, base[2] + c, k]
    out[0] = m[0] + m[4] * p[2] - m[5] * p[1]
    out[1] = m[1] + m[5] * p[0] - m[3] * p[2]
    out[2] = m[2] + m[3] * p[1] - m[4] * p[0]


@numba.njit(cache=True, nogil=True, fastmath=True)
def _tracks(begin, end, points, views, field, start, last, settings, pieces, count, summary):
    """Follows the points begin…end along the flow field from frame `start` to `last` of the clip, and writes their
    pieces, how many these are, and their summaries."""
    view, world, normal, pixel = points.view_index, points.place, points.normal, points.pixel
    frame, centre, w2c, K, observed = views.frame, views.centre, views.w2c, views.intrinsics, views.observed
    agreeing_views, contradicted = summary.agreeing_views, summary.contradicted
    steps = int(settings.max_frames)
    for i in range(begin, end):
        path = np.zeros((2 * steps + 1, 3), np.float32)  # places at own frame - steps … + steps
        p, flow, m = np.empty(3, np.float32), np.empty(3, np.float32), np.empty(6, np.float32)
        reach = np.zeros(2, np.float32)
        here = frame[view[i]]
        path[steps] = world[i]
        for side in range(2):
            direction = 2 * side - 1
            p[:] = world[i]
            reached, needed = 0, np.float32(-1)
            for s in range(1, steps + 1):
                now = here + direction * s
                if now < start - 0.25 or now > last + 0.25:
                    needed = reached + 0.6  # to the clip's very end, at full strength
                    break
                interval = round((now if direction < 0 else now - 1) - start)
                interval = min(max(interval, 0), len(field) - 1)
                flow_at(field, interval, p, m, flow)
                for k in range(3):
                    flow[k] *= direction
                if s == 1:  # the pixel's own motion vector is exact: two of three components are known
                    satisfy(points.constraint[i, side], flow)
                for k in range(3):
                    p[k] += flow[k]
                taken = gone = False
                for j in range(len(frame)):
                    if abs(frame[j] - now) > 0.25:
                        continue
                    tolerance = (settings.tolerance + settings.drift * s) * pixel[i]
                    error, known = _depth_error(p[0], p[1], p[2], j, w2c, K, observed, tolerance)
                    if not known:
                        continue
                    if error < -1:
                        gone = True
                    elif error <= 1:
                        agreeing_views[i] += 1
                        cosine, square = np.float32(0), np.float32(1e-9)
                        for k in range(3):
                            cosine += normal[i, k] * (centre[j, k] - p[k])
                            square += (centre[j, k] - p[k]) ** 2
                        taken |= cosine > settings.min_cosine * np.sqrt(square)
                if gone:
                    needed = reached + 0.3
                    contradicted[i] = 1
                    break
                path[steps + direction * s] = p
                reached = s
                if taken:
                    needed = settings.handover * s
                    break
            if needed < 0:
                needed = reached + 0.3
            for s in range(reached + 1, steps + 1):  # beyond the last known place: straight on
                for k in range(3):
                    a, b = steps + direction * (s - 1), steps + direction * max(s - 2, 0)
                    path[steps + direction * s, k] = path[a, k] + (path[a, k] - path[b, k])
            reach[side] = max(needed, 0.3)
            if side == 0:
                summary.frames_before[i] = needed
            else:
                summary.frames_after[i] = needed
        out = pieces.time[i], pieces.half_length[i], pieces.place[i], pieces.velocity[i]
        count[i] = _cut(path, steps, here, -reach[0], reach[1], settings.straightness * pixel[i], *out)


@numba.njit(cache=True, fastmath=True)
def satisfy(row, flow):
    """Moves flow (3) by the least amount such that A·flow = b holds; row (8): A (2,3) row by row, then b (2). (Written
    so that its bits do not depend on whether it was compiled now or comes from numba's cache.)"""
    aa = row[0] ** 2 + row[1] ** 2 + row[2] ** 2
    ab = row[0] * row[3] + row[1] * row[4] + row[2] * row[5]
    bb = row[3] ** 2 + row[4] ** 2 + row[5] ** 2
    r = row[6] - (row[0] * flow[0] + row[1] * flow[1] + row[2] * flow[2])
    s = row[7] - (row[3] * flow[0] + row[4] * flow[1] + row[5] * flow[2])
    d = 1 / (aa * bb - ab * ab)
    x, y = (bb * r - ab * s) * d, (aa * s - ab * r) * d
    for k in range(3):
        flow[k] += x * row[k] + y * row[3 + k]


@numba.njit(cache=True, fastmath=True)
def _place_at(path, steps, s, out):
    """Place on the path s frames from its middle."""
    low = int(np.floor(s))
    low = min(max(low, -steps), steps - 1)
    for k in range(3):
        out[k] = path[steps + low, k] + (s - low) * (path[steps + low + 1, k] - path[steps + low, k])


@numba.njit(cache=True, fastmath=True)
def _cut(path, steps, here, first, end, straightness, time, half_length, place, velocity):
    """Cuts first…end (frames from the path's middle) into pieces that stay within `straightness` of their chords,
    each as long as it can be; writes those of one point, as in `Pieces`, and returns how many."""
    most = len(time)
    a, b, m = np.empty(3, np.float32), np.empty(3, np.float32), np.empty(3, np.float32)
    n = 0
    begin = first
    while n < most and begin < end - 1e-3:
        stop = end
        while n < most - 1:
            _place_at(path, steps, begin, a)
            _place_at(path, steps, stop, b)
            worst = np.float32(0)
            for s in range(int(np.ceil(begin)), int(np.floor(stop)) + 1):
                w = (s - begin) / (stop - begin)
                square = np.float32(0)
                for k in range(3):
                    square += (path[steps + s, k] - a[k] - w * (b[k] - a[k])) ** 2
                worst = max(worst, square)
            shorter = np.float32(np.ceil(stop) - 1)
            if worst <= straightness * straightness or shorter <= begin + 0.5:
                break
            stop = shorter
        _place_at(path, steps, begin, a)
        _place_at(path, steps, stop, b)
        _place_at(path, steps, 0.5 * (begin + stop), m)
        time[n] = here + 0.5 * (begin + stop)
        half_length[n] = 0.5 * (stop - begin)
        for k in range(3):
            place[n, k] = 0.25 * (a[k] + b[k]) + 0.5 * m[k]
            velocity[n, k] = (b[k] - a[k]) / (stop - begin)
        n += 1
        begin = stop
    return n
