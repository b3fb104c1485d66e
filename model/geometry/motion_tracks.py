# SPDX-License-Identifier: GPL-3.0-or-later
"""Surface points followed through the clip from depth and motion vectors, where no mesh is known.

What a pixel shows and no point explains becomes a new point. It goes along the scene flow from frame to frame, both
ways; each step is the least squares of the scene flow and of what the views of both frames show of the point, their
motion vectors and their depth. Where a view sees through it, it ends. How far it may have strayed is kept account of:
it is there while that is little, and beyond only where no other point is known (`track_windows`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np

from ...datagen.track_file import SurfaceTracks
from ..parallel import chunks, parallel_for
from ..views import Views
from .scene_flow import single

# (numba's cache does not see another file change: where these are changed, this file must be touched.)
from .surface_evidence import (
    FREE,
    Surface,
    gather,
    gather_depth,
    lean,
    off,
    pixel_at,
    seen_at,
    solve,
    surface_of,
    third_axis,
    turn,
    weight_of,
)
from .track_windows import fill_gaps
from .tracking import flow_at


class MotionSettings(NamedTuple):
    """How points are sown and followed; distances in pixel sizes."""

    apart: float = 0.9  # points that pixels beside one another start are at least so far apart
    near: float = 1.3  # a pixel is explained by a point so near along the surface …
    deep: float = 2.0  # … and so near across it
    tolerance: float = 1.3  # across the surface, by which a point that is seen may be off, plus …
    drift: float = 0.3  # … this for each frame since it was last seen, …
    most: float = 3.0  # … up to this in all
    steepest: float = 0.2  # cosine: pixels that see the surface under less start no points
    doubt: float = 0.25  # share of a step that it may be wrong by, where no view sees the point, …
    doubt_seen: float = 0.06  # … and where one does; …
    sure: float = 0.7  # … as long as the sum is below this it is sure where the point is …
    lost: float = 6.0  # … up to where the sum is this, …
    gap: float = 2.0  # … and beyond where there is no other point so near
    most_pixels: float = 4000.0  # that a view shows of the object; points are farther apart where pixels are finer
    prior: float = 0.03  # weight of the scene flow against what motion vectors say of a point's own step
    depth: float = 4.0  # weight of the depth of what is seen, as a multiple of that of its motion
    turn: float = 0.3  # share by which a normal that is seen turns the point's


MOTION = MotionSettings()
COVERED = np.float32(1.4)  # area of surface to each of points that are 1 apart at least, sown at random


class _Points(NamedTuple):
    """N points followed through F frames, as in SurfaceTracks but float32."""

    position: np.ndarray  # (N,F,3)
    rotation: np.ndarray  # (N,F,4)
    most: np.ndarray  # (N,2) first and last frame to which each was followed
    sure: np.ndarray  # (N,2) the same, of frames at which it is sure where it is
    area: np.ndarray  # (N,)


def motion_tracks(views: Views, known: SurfaceTracks | None = None, settings: MotionSettings = MOTION) -> SurfaceTracks:
    """Points of what the views with depth and flow show, beside the `known` ones of the same clip, which explain pixels
    but are not returned. CPU tensors."""
    frames = 1 if views.frame_step == 2 and not views.time.any() else round(2 / views.frame_step) + 1
    surface, field = surface_of(views)
    rules = single(_thinly(settings, views))
    there: list[_Points] = []
    if known is not None:
        window = np.stack([known.first, known.last], 1).astype(np.int64)
        there = [_Points(known.position, known.rotation, window, window, known.area)]
    found: list[_Points] = []
    pixel = np.float32(np.median(surface.pixel)) if len(surface.pixel) else np.float32(1)
    for f in _order(frames):
        new = _sown(surface, f, frames, [*there, *found], rules)
        jobs = chunks(len(new.area), 1024)
        parallel_for(jobs, lambda a, b, new=new, f=f: _follow(a, b, f, pixel, surface, field, rules, *new[:4]))
        found.append(new)
    points = _Points(*map(np.concatenate, zip(*found, strict=True)))
    fill_gaps(points.position, points.sure, points.most, rules.gap * pixel)
    frame = np.arange(frames)[None].clip(points.sure[:, :1], points.sure[:, 1:])[..., None]
    return SurfaceTracks(
        np.take_along_axis(points.position, frame, 1),
        np.take_along_axis(points.rotation, frame, 1).astype(np.float16),
        points.sure[:, 0].astype(np.int32),
        points.sure[:, 1].astype(np.int32),
        points.area,
    )


def _thinly(settings: MotionSettings, views: Views) -> MotionSettings:
    """Settings by which pictures of any size start about as many points as those of `most_pixels` do, enough for all
    that a fit can use; each is followed by all pixels."""
    farther = max(math.sqrt(float((views.alpha > 0.5).float().sum((1, 2)).mean()) / settings.most_pixels), 1.0)
    return settings._replace(apart=farther * settings.apart, near=farther * settings.near)


def _order(frames: int) -> list[int]:
    """Frames 0…frames - 1, from the middle on ever finer."""
    found: dict[int, None] = {}
    parts = 1
    while len(found) < frames:
        for k in range(parts):
            found.setdefault((2 * k + 1) * frames // (2 * parts))
        parts *= 2
    return list(found)


def _sown(surface: Surface, f: int, frames: int, points: list[_Points], rules: MotionSettings) -> _Points:
    """The points that pixels of frame f start which none of `points` explains; they are at frame f alone."""
    random = np.random.default_rng(f)
    started: list[np.ndarray] = []  # rows
    for v in np.flatnonzero(surface.frame == f):
        explained = np.zeros(surface.row.shape[1:], np.bool_)
        for p in points:
            alive = (p.sure[:, 0] <= f) & (f <= p.sure[:, 1])
            _explain(p.position[alive, f], v, surface, explained, rules.near, rules.deep)
        for rows in started:
            _explain(surface.place[rows], v, surface, explained, rules.near, rules.deep)
        left = np.flatnonzero(~explained & (surface.row[v] >= 0))
        started.append(_thinned(random.permutation(left), v, surface, explained, rules))
    rows = np.concatenate(started) if started else np.zeros(0, np.int64)
    n = len(rows)
    position, rotation = np.zeros((n, frames, 3), np.float32), np.zeros((n, frames, 4), np.float32)
    position[:], rotation[:] = surface.place[rows, None], surface.turn[rows, None]
    when = np.full((n, 2), f)
    return _Points(position, rotation, when, when.copy(), COVERED * (rules.apart * surface.pixel[rows]) ** 2)


@numba.njit(cache=True, nogil=True, fastmath=True)
def _explain(places, j, surface, explained, near, deep):
    """Marks in explained (H,W) the pixels of view j that the places (n,3) explain."""
    height, width = explained.shape
    around = max(int(near), 1)  # pixels, to each side
    for i in range(len(places)):
        u, v, depth = pixel_at(places[i], j, surface)
        if depth == 0:
            continue
        for y in range(max(v - around, 0), min(v + around + 1, height)):
            for x in range(max(u - around, 0), min(u + around + 1, width)):
                r = surface.row[j, y, x]
                if r >= 0 and not explained[y, x]:
                    across, along = off(places[i], r, surface)
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
def _follow(begin, end, here, size, surface, field, rules, position, rotation, most, sure):
    """Follows the points begin…end from frame `here` both ways."""
    for i in range(begin, end):
        for side in range(2):
            most[i, side], sure[i, side] = _follow_one(
                here, side, size, surface, field, rules, position[i], rotation[i]
            )


@numba.njit(cache=True, nogil=True, fastmath=True)
def _follow_one(here, side, size, surface, field, rules, position, rotation):
    """Follows a point with position (F,3) and rotation (F,4) from frame `here` on, to later ones (side 1) or earlier
    ones (0) -> the last frame that it comes to, and the last at which it is sure where it is."""
    frames, direction = len(position), 2 * side - 1
    start, p, q = position[here].copy(), position[here].copy(), rotation[here].copy()
    flow, more, other, normal = np.empty(3, np.float32), np.empty(3, np.float32), p.copy(), np.empty(3, np.float32)
    m, spin, rows = np.empty(6, np.float32), np.empty(3, np.float32), np.empty(9, np.float32)
    confirmed, f, sure, doubt = here, here, here, np.float32(0)
    while 0 <= f + direction < frames:
        g, interval = f + direction, (f if side else f - 1)
        start[:] = p
        third_axis(q, normal)
        flow_at(field, interval, p, m, flow)
        for k in range(3):
            flow[k] *= direction
            spin[k] = direction * m[3 + k]
        rows[:] = 0
        more[:] = 0
        tolerance = min(rules.tolerance + rules.drift * abs(f - confirmed), rules.most)
        for j in range(len(surface.frame)):
            if surface.frame[j] == f:
                r = seen_at(p, normal, j, tolerance, surface)
                if r >= 0:
                    w = weight_of(p, normal, r, surface)
                    gather(r, w, side, direction, interval, surface, field, m, other, rows)
        solve(rows, rules.prior, more)
        turn(q, spin)
        third_axis(q, normal)
        tolerance = min(rules.tolerance + rules.drift * abs(g - confirmed), rules.most)
        for k in range(3):
            p[k] = start[k] + flow[k] + more[k]
        for j in range(len(surface.frame)):
            if surface.frame[j] == g:
                r = seen_at(p, normal, j, tolerance, surface)
                if r >= 0:
                    w = weight_of(p, normal, r, surface)
                    gather(r, w, 1 - side, direction, interval, surface, field, m, other, rows)
        other[:] = p
        seen = gone = False
        for j in range(len(surface.frame)):
            if surface.frame[j] == g:
                r = seen_at(p, normal, j, tolerance, surface)
                if r == FREE:
                    gone = True
                elif r >= 0:
                    seen = True
                    w = weight_of(p, normal, r, surface)
                    gather_depth(p, r, rules.depth * w, more, surface, rows)
                    lean(q, normal, r, rules.turn * w, surface)
        solve(rows, rules.prior, more)
        for k in range(3):
            p[k] = start[k] + flow[k] + more[k]
        if gone or doubt > rules.lost:
            break
        square = np.float32(0)
        for k in range(3):
            square += (p[k] - start[k]) ** 2
        doubt += (rules.doubt_seen if rows[0] + rows[2] + rows[5] > 0.5 else rules.doubt) * np.sqrt(square) / size
        if doubt < rules.sure:
            sure = g
        position[g], rotation[g] = p, q
        if seen:
            for h in range(confirmed + direction, g, direction):  # what was wrong became so little by little
                part = np.float32(abs(h - confirmed)) / abs(g - confirmed)
                for k in range(3):
                    position[h, k] += part * (p[k] - other[k])
            confirmed = g
        f = g
    return f, sure
