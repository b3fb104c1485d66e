# SPDX-License-Identifier: GPL-3.0-or-later
"""Following surface points through time: scene flow from motion vectors, and tracks along it.

A motion vector constrains two of the three components of a point's motion. All that the views say about one
frame interval is gathered in a voxel grid as small least-squares problems for a rigid motion each; views from
different sides complete each other, coarser levels fill in where nothing was seen (the far side of a leg moves
like its near side). Along this field each pixel's point is followed both ways until a view sees the same surface well
enough (its own pixel takes over), sees through the point (it is wrong by then), or the clip ends. A track is
cut into pieces that are straight to within a fraction of a pixel: each becomes one Gaussian.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
import torch
from torch import Tensor

from ..parallel import chunks, parallel_for
from ..views import Views

GRID = 24  # voxels along [-EXTENT, EXTENT]
EXTENT = 1.15
BEYOND = (0.02, 5e-3, 1e-3)  # weight of what is known one to three intervals away: motion changes between frames
COARSE, COARSEST = 5e-2, 1e-5  # weights of the levels that fill in
SLIDE, SPIN = 1e-3, 1e-3  # pull of a voxel's motion and turn towards none, as multiples of what is known
TOLERANCE = 1.3  # depth agreement, in pixel sizes, plus …
DRIFT = 0.5  # … this per frame of following
LONGEST = 8.0  # frames that a point is followed
FRONTAL = 0.15  # a view that sees a surface under a cosine above this may take over from another
HANDOVER = 0.45  # a point is needed for this part of the time until another view takes over
STRAIGHT = 0.5  # a piece's greatest distance from its chord, in pixel sizes
PIECES = 8  # most pieces per track


@dataclass
class Points:
    """The n surface points that V views see, in the order of their views."""

    view: Tensor  # (n,) index of the view
    place: Tensor  # (n,3) world
    normal: Tensor  # (n,3) unit, towards the camera
    pixel: Tensor  # (n,) size of a pixel at the surface
    to_next: Tensor  # (n,2) motion vectors to the next frame and to the previous one, in pixels
    to_previous: Tensor
    depth: Tensor  # (n,) planar z
    ray: Tensor  # (n,2) x/z and y/z in the camera


def follow(views: Views, points: Points, seen: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """seen (V,H,W): what each pixel shows, for comparison: planar z, free space (inf), or unknown (-1).

    -> pieces (M,8): middle (frames since the clip's middle), half length in frames, place xyz at the middle,
    velocity xyz per frame; owner (M,) index 0..n-1 of the point that each belongs to, ascending; summary
    (n,4): frames followed before and after, how many views agree, 1 where a view contradicted it."""
    frame = views.time / views.frame_step
    last = 1 / views.frame_step if views.frame_step < 2 else 0.0
    intervals = max(round(2 * last), 1)
    A, next_b, previous_b = constraints(views, points)
    field = scene_flow(views, points, A, next_b, previous_b, intervals)
    own = torch.stack([torch.cat([A.flatten(1), b], -1) for b in (next_b, previous_b)], 1)
    w2c = torch.linalg.inv(views.c2w)
    arrays = [points.place, points.normal, points.pixel, own, frame, views.c2w[:, :3, 3], w2c, views.intrinsics, seen]
    arrays = [np.ascontiguousarray(x.numpy(), np.float32) for x in arrays]
    settings = np.array([TOLERANCE, DRIFT, LONGEST, FRONTAL, HANDOVER, STRAIGHT], np.float32)
    order = np.argsort(arrays[4], kind="stable")
    n = len(points.view)
    pieces = np.zeros((n, PIECES, 8), np.float32)
    count, summary = np.zeros(n, np.int64), np.zeros((n, 4), np.float32)
    known = (points.view.numpy(), *arrays, field.numpy(), order, np.float32(-last), np.float32(last), settings)
    parallel_for(chunks(n, 4096), lambda first, end: _tracks(first, end, *known, pieces, count, summary))
    taken = np.arange(PIECES)[None] < count[:, None]
    owner = np.repeat(np.arange(len(count)), count)
    return torch.from_numpy(pieces[taken]), torch.from_numpy(owner), torch.from_numpy(summary)


def constraints(views: Views, points: Points) -> tuple[Tensor, Tensor, Tensor]:
    """-> A (n,2,3) and b (n,2) for the motion to the next frame and to the previous one: A·motion = b, exact in
    perspective."""
    R = views.c2w[:, :3, :3][points.view]
    A = R[:, :, :2].mT - points.ray[..., None] * R[:, None, :, 2]
    size = points.depth[:, None] / views.intrinsics[points.view, :2]
    return A, points.to_next * size, points.to_previous * size


def scene_flow(views: Views, points: Points, A: Tensor, next_b: Tensor, previous_b: Tensor, intervals: int) -> Tensor:
    """-> (intervals, G, G, G, 6) motion from each frame of the clip to its next, on voxels over
    [-EXTENT, EXTENT]³ (indices x, y, z): v and ω, by which a point p of the voxel moves by v + ω x p."""
    field = np.zeros((intervals, GRID, GRID, GRID, 6), np.float32)
    if not (next_b.any() or previous_b.any()):  # no motion anywhere (the sweep knows none): zero solves it
        return torch.from_numpy(field)
    frame = ((views.time + 1) / views.frame_step).round().long()[points.view].numpy()
    B = torch.cat([A, torch.linalg.cross(points.place[:, None].expand_as(A), A)], -1)  # motion = v + ω x place
    cell = ((points.place / EXTENT + 1) * (0.5 * GRID)).long().clamp(0, GRID - 1)
    cell = (cell[:, 0] * GRID + cell[:, 1]) * GRID + cell[:, 2]
    known = [x.contiguous().numpy() for x in (cell, B, next_b, previous_b)]
    weights = np.array([COARSE, COARSEST, SLIDE, SPIN], np.float32)
    beyond = np.array([1, *BEYOND], np.float32)
    parallel_for([(t,) for t in range(intervals)], lambda t: _field(t, frame, *known, beyond, weights, field))
    return torch.from_numpy(field)


@numba.njit(cache=True, nogil=True, fastmath=True)
def _field(t, frame, cell, B, next_b, previous_b, beyond, weights, out):
    """Writes the motion of interval t to out (T,G,G,G,6): least squares of B·(v,ω) = b over the points of each
    voxel, joined with those of neighbours in time and space. frame and cell (n), B (n,2,6), b (n,2)."""
    G = out.shape[1]
    Q = G // 4
    coarse_weight, coarsest_weight, slide, spin = weights
    near = np.zeros((G, G, G, 27), np.float32)  # lower triangles of BᵀB, then Bᵀb
    flat = near.reshape(-1, 27)
    for i in range(len(frame)):
        for before in range(2):
            away = abs(frame[i] - before - t)
            if away >= len(beyond) or not 0 <= frame[i] - before < len(out):
                continue
            for r in range(2):
                b = -previous_b[i, r] if before else next_b[i, r]
                q = 0
                for j in range(6):
                    w = beyond[away] * B[i, r, j]
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
            rows[c] = coarse_weight * coarse[X // 4, Y // 4, Z // 4, c] + coarsest_weight * whole[c]
        _solve(rows, X + 1.5, Y + 1.5, Z + 1.5, slide, spin, rest)
        for x in range(X, X + 4):
            for y in range(Y, Y + 4):
                for z in range(Z, Z + 4):
                    if near[x, y, z, 0] + near[x, y, z, 2] + near[x, y, z, 5] == 0:  # nothing seen here
                        out[t, x, y, z] = rest
                        continue
                    for c in range(27):
                        rows[c] = near[x, y, z, c] + coarse_weight * coarse[X // 4, Y // 4, Z // 4, c]
                        rows[c] += coarsest_weight * whole[c]
                    _solve(rows, x, y, z, slide, spin, out[t, x, y, z])


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
def _solve(rows, x, y, z, slide, spin, out):
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
            N[i, j] = rows[q] + (spin * trace if i == j and i > 2 else 0)
            for k in range(3):
                N[i, j] += slide * trace * at_middle[k, i] * at_middle[k, j]
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


@numba.njit(cache=True, fastmath=True)
def _compare(x, y, z, j, w2c, K, seen, tol):
    """How view j sees a point: (depth error / tol, True), -inf in free space; (0, False) where it is outside
    of the image or unknown."""
    depth = w2c[j, 2, 0] * x + w2c[j, 2, 1] * y + w2c[j, 2, 2] * z + w2c[j, 2, 3]
    if depth < 0.01:
        return 0.0, False
    right = w2c[j, 0, 0] * x + w2c[j, 0, 1] * y + w2c[j, 0, 2] * z + w2c[j, 0, 3]
    down = w2c[j, 1, 0] * x + w2c[j, 1, 1] * y + w2c[j, 1, 2] * z + w2c[j, 1, 3]
    u = int(np.floor(right / depth * K[j, 0] + K[j, 2]))
    v = int(np.floor(down / depth * K[j, 1] + K[j, 3]))
    if u < 0 or v < 0 or u >= seen.shape[2] or v >= seen.shape[1] or seen[j, v, u] < 0:
        return 0.0, False
    return (depth - seen[j, v, u]) / tol, True


@numba.njit(cache=True, fastmath=True)
def _flow_at(field, interval, p, out):
    """Trilinear value of the scene flow at p (3)."""
    grid = field.shape[1]
    base = np.empty(3, np.int64)
    part = np.empty(3, np.float32)
    for k in range(3):
        g = min(max((p[k] / EXTENT + 1) * 0.5 * grid - 0.5, 0.0), grid - 1.001)
        base[k] = int(g)
        part[k] = g - base[k]
    m = np.zeros(6, np.float32)
    for corner in range(8):
        a, b, c = corner & 1, (corner >> 1) & 1, corner >> 2
        w = (part[0] if a else 1 - part[0]) * (part[1] if b else 1 - part[1]) * (part[2] if c else 1 - part[2])
        for k in range(6):
            m[k] += w * field[interval, base[0] + a, base[1] + b, base[2] + c, k]
    out[0] = m[0] + m[4] * p[2] - m[5] * p[1]
    out[1] = m[1] + m[5] * p[0] - m[3] * p[2]
    out[2] = m[2] + m[3] * p[1] - m[4] * p[0]


@numba.njit(cache=True, nogil=True, fastmath=True)
def _tracks(
    begin, end, view, world, normal, pixel, own, frame, eye, w2c, K, seen, field, order, start, last, settings,
    pieces, count, summary,
):  # fmt: skip
    """Follows the points begin…end and writes their pieces, how many these are, and their summaries."""
    tolerance, drift, longest, frontal, handover, straight = settings
    steps, most, views = int(longest), pieces.shape[1], len(frame)
    for i in range(begin, end):
        path = np.zeros((2 * steps + 1, 3), np.float32)  # places at own frame - steps … + steps
        p, flow = np.empty(3, np.float32), np.empty(3, np.float32)
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
                _flow_at(field, interval, p, flow)
                for k in range(3):
                    flow[k] *= direction
                if s == 1:  # the pixel's own motion vector is exact: two of three components are known
                    _agree(own[i, 1 - side], flow)
                for k in range(3):
                    p[k] += flow[k]
                taken = gone = False
                for m in range(views):
                    j = order[m]
                    if abs(frame[j] - now) > 0.25:
                        continue
                    tol = (tolerance + drift * s) * pixel[i]
                    error, known = _compare(p[0], p[1], p[2], j, w2c, K, seen, tol)
                    if not known:
                        continue
                    if error < -1:
                        gone = True
                    elif error <= 1:
                        summary[i, 2] += 1
                        cosine, square = np.float32(0), np.float32(1e-9)
                        for k in range(3):
                            cosine += normal[i, k] * (eye[j, k] - p[k])
                            square += (eye[j, k] - p[k]) ** 2
                        taken |= cosine > frontal * np.sqrt(square)
                if gone:
                    needed = reached + 0.3
                    summary[i, 3] = 1
                    break
                path[steps + direction * s] = p
                reached = s
                if taken:
                    needed = handover * s
                    break
            if needed < 0:
                needed = reached + 0.3
            for s in range(reached + 1, steps + 1):  # beyond the last known place: straight on
                for k in range(3):
                    a, b = steps + direction * (s - 1), steps + direction * max(s - 2, 0)
                    path[steps + direction * s, k] = path[a, k] + (path[a, k] - path[b, k])
            reach[side] = max(needed, 0.3)
            summary[i, side] = needed
        count[i] = _cut(path, steps, here, -reach[0], reach[1], straight * pixel[i], most, pieces[i])


@numba.njit(cache=True, fastmath=True)
def _agree(own, flow):
    """Moves flow (3) by the least amount such that A·flow = b holds, own = A (2x3 row by row), b (2)."""
    aa = own[0] ** 2 + own[1] ** 2 + own[2] ** 2
    ab = own[0] * own[3] + own[1] * own[4] + own[2] * own[5]
    bb = own[3] ** 2 + own[4] ** 2 + own[5] ** 2
    r = own[6] - (own[0] * flow[0] + own[1] * flow[1] + own[2] * flow[2])
    s = own[7] - (own[3] * flow[0] + own[4] * flow[1] + own[5] * flow[2])
    d = 1 / (aa * bb - ab * ab)
    x, y = (bb * r - ab * s) * d, (aa * s - ab * r) * d
    for k in range(3):
        flow[k] += x * own[k] + y * own[3 + k]


@numba.njit(cache=True, fastmath=True)
def _at(path, steps, s, out):
    """Place on the path s frames from its middle."""
    low = int(np.floor(s))
    low = min(max(low, -steps), steps - 1)
    for k in range(3):
        out[k] = path[steps + low, k] + (s - low) * (path[steps + low + 1, k] - path[steps + low, k])


@numba.njit(cache=True, fastmath=True)
def _cut(path, steps, here, first, end, straight, most, out):
    """Cuts first…end (frames from the path's middle) into pieces that stay within `straight` of their chords,
    each as long as it can be; writes them to out (most,8) and returns how many."""
    a, b, m = np.empty(3, np.float32), np.empty(3, np.float32), np.empty(3, np.float32)
    n = 0
    begin = first
    while n < most and begin < end - 1e-3:
        stop = end
        while n < most - 1:
            _at(path, steps, begin, a)
            _at(path, steps, stop, b)
            worst = np.float32(0)
            for s in range(int(np.ceil(begin)), int(np.floor(stop)) + 1):
                w = (s - begin) / (stop - begin)
                square = np.float32(0)
                for k in range(3):
                    square += (path[steps + s, k] - a[k] - w * (b[k] - a[k])) ** 2
                worst = max(worst, square)
            shorter = np.float32(np.ceil(stop) - 1)
            if worst <= straight * straight or shorter <= begin + 0.5:
                break
            stop = shorter
        _at(path, steps, begin, a)
        _at(path, steps, stop, b)
        _at(path, steps, 0.5 * (begin + stop), m)
        out[n, 0] = here + 0.5 * (begin + stop)
        out[n, 1] = 0.5 * (stop - begin)
        for k in range(3):
            out[n, 2 + k] = 0.25 * (a[k] + b[k]) + 0.5 * m[k]
            out[n, 5 + k] = (b[k] - a[k]) / (stop - begin)
        n += 1
        begin = stop
    return n
