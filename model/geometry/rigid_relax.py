# SPDX-License-Identifier: GPL-3.0-or-later
"""Points that were followed, put right by one another: what is near keeps its shape, nearly, from frame to frame.

Where a point is unseen, others of its part are seen, and it is itself at other frames. All that is known is one sum of
squares: the depth and the motion vectors that the views show of a point, the scene flow, and that a point is where
each of its neighbours, turned as it is at that frame, says (as rigid as possible: Sorkine and Alexa 2007). It is made
less by going over the points' turns and places in turn.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from ..parallel import chunks, parallel_for
from .scene_flow import single

# (numba's cache does not see another file change: where these are changed, this file must be touched.)
from .surface_evidence import Surface, gather, gather_depth, seen_at, solve, third_axis, turn, weight_of
from .tracking import flow_at


class RelaxSettings(NamedTuple):
    """How points are put right; distances in pixels."""

    rounds: int = 3  # in each of which is asked anew what the views show, …
    sweeps: int = 6  # … and so often gone over all points
    reach: float = 7.0  # of neighbours
    tolerance: float = 3.0  # across the surface, by which a point that is seen may be off in the first round …
    tight: float = 1.3  # … and in the last one
    rigid: float = 0.05  # weight of a neighbour, that of a motion vector is 1, …
    depth: float = 4.0  # … that of a depth seen, …
    prior: float = 0.03  # … and that of the scene flow
    loose: float = 0.7  # change of shape that halves the weight of a neighbour
    unseen: float = 0.03  # weight in the shape of a moment when not both are seen


RELAX = RelaxSettings()
NEIGHBOURS = 10


class _State(NamedTuple):
    """N points through F frames."""

    position: np.ndarray  # (N,F,3)
    rotation: np.ndarray  # (N,F,4)
    window: np.ndarray  # (N,2) first and last frame
    near: np.ndarray  # (N,K) neighbours, -1 where there are fewer
    shape: np.ndarray  # (N,K,3) where they are in the point's own frame of reference
    weight: np.ndarray  # (N,K)
    seen: np.ndarray  # (N,F) how well, 0..1
    depth: np.ndarray  # (N,F,9) normal equations of the place
    motion: np.ndarray  # (N,F,9) normal equations of the motion to the next frame


def relax(
    position: np.ndarray,
    rotation: np.ndarray,
    window: np.ndarray,
    pixel: float,
    surface: Surface,
    field: np.ndarray,
    settings: RelaxSettings = RELAX,
) -> None:
    """Puts the points right, in place: position (N,F,3), rotation (N,F,4); window (N,2): their first and last frame."""
    n, frames = position.shape[:2]
    if n < 2 or frames < 2:
        return
    near = _neighbours(position, window, settings.reach * pixel)
    sizes = ((n, NEIGHBOURS, 3), (n, NEIGHBOURS), (n, frames), (n, frames, 9), (n, frames, 9))
    state = _State(position, rotation, window, near, *(np.zeros(s, np.float32) for s in sizes))
    rules, size = single(settings), np.float32(pixel)
    jobs = chunks(n, 1024)
    for k in range(settings.rounds):
        part = k / max(settings.rounds - 1, 1)
        tolerance = np.float32(settings.tolerance + part * (settings.tight - settings.tolerance))
        parallel_for(jobs, lambda a, b, t=tolerance: _ask(a, b, t, state, surface, field, rules))
        for _ in range(settings.sweeps):
            parallel_for(jobs, lambda a, b: _shapes(a, b, size, state, rules))
            for odd in range(2):
                parallel_for([(t,) for t in range(odd, frames, 2)], lambda t: _sweep(t, state, rules))


def _neighbours(position: np.ndarray, window: np.ndarray, reach: float) -> np.ndarray:
    """(N,K) some points that are within `reach` at a frame at which both are there, -1 where there are fewer."""
    n = len(window)
    near = np.full((n, NEIGHBOURS), -1, np.int64)
    middle = window.sum(1) // 2
    random = np.random.default_rng(0)
    for f in np.unique(middle):
        alive = random.permutation(np.flatnonzero((window[:, 0] <= f) & (f <= window[:, 1])))
        cell = np.floor(position[alive, f] / reach).astype(np.int64) + 512
        key = (cell[:, 0] * 1024 + cell[:, 1]) * 1024 + cell[:, 2]
        order = np.argsort(key, kind="stable")
        mine = np.flatnonzero(middle == f)
        _find(mine, position[:, f], np.float32(reach), alive[order], key[order], near)
    return near


@numba.njit(cache=True, nogil=True)
def _find(mine, place, reach, among, key, near):
    """Writes to near (N,K) neighbours of the points `mine` of `among` (m,), sorted by their cells' key (m,)."""
    far = np.empty(near.shape[1], np.float32)
    for i in mine:
        count = 0
        cell = np.floor(place[i] / reach).astype(np.int64) + 512
        total = 0
        for x in range(cell[0] - 1, cell[0] + 2):
            for y in range(cell[1] - 1, cell[1] + 2):
                for z in range(cell[2] - 1, cell[2] + 2):
                    k = (x * 1024 + y) * 1024 + z
                    for at in range(np.searchsorted(key, k), np.searchsorted(key, k + 1)):
                        j = among[at]
                        square = ((place[j] - place[i]) ** 2).sum()
                        if j == i or square > reach * reach:
                            continue
                        total += 1
                        if count < len(far):
                            near[i, count] = j
                            count += 1
                        else:  # each is as likely as another to be kept
                            h = (j * 2654435761 + i * 40503 + total * 69069) % 1000003 % total
                            if h < len(far):
                                near[i, h] = j


@numba.njit(cache=True, nogil=True, fastmath=True)
def _ask(begin, end, tolerance, state, surface, field, rules):
    """What the views say of the points begin…end where they are now: depth, motion and seen."""
    frames = state.position.shape[1]
    m, flow = np.empty(6, np.float32), np.empty(3, np.float32)
    other, normal = np.empty(3, np.float32), np.empty(3, np.float32)
    for i in range(begin, end):
        depth, motion, seen = state.depth[i], state.motion[i], state.seen[i]
        depth[:], motion[:], seen[:] = 0, 0, 0
        for t in range(state.window[i, 0], state.window[i, 1] + 1):
            p = state.position[i, t]
            third_axis(state.rotation[i, t], normal)
            for j in range(len(surface.frame)):
                if surface.frame[j] != t:
                    continue
                r = seen_at(p, normal, j, tolerance, surface)
                if r < 0:
                    continue
                w = weight_of(p, normal, r, surface)
                seen[t] = max(seen[t], w)
                gather_depth(p, r, rules.depth * w, p, surface, depth[t])
                if t < frames - 1:
                    gather(p, r, w, 1, np.float32(1), t, surface, field, m, other, motion[t])
                if t > 0:
                    gather(p, r, w, 0, np.float32(1), t - 1, surface, field, m, other, motion[t - 1])
        for t in range(state.window[i, 0], min(state.window[i, 1], frames - 2) + 1):
            flow_at(field, t, state.position[i, t], m, flow)
            a = motion[t]
            a[0] += rules.prior
            a[2] += rules.prior
            a[5] += rules.prior
            a[6] += a[0] * flow[0] + a[1] * flow[1] + a[3] * flow[2]
            a[7] += a[1] * flow[0] + a[2] * flow[1] + a[4] * flow[2]
            a[8] += a[3] * flow[0] + a[4] * flow[1] + a[5] * flow[2]


@numba.njit(cache=True, fastmath=True)
def _rotate(q, v, way, out):
    """out (3): v (3) turned by the quaternion q (4), or against it (way -1)."""
    w, x, y, z = q[0], way * q[1], way * q[2], way * q[3]
    a, b, c = 2 * (y * v[2] - z * v[1]), 2 * (z * v[0] - x * v[2]), 2 * (x * v[1] - y * v[0])
    out[0] = v[0] + w * a + y * c - z * b
    out[1] = v[1] + w * b + z * a - x * c
    out[2] = v[2] + w * c + x * b - y * a


@numba.njit(cache=True, nogil=True, fastmath=True)
def _shapes(begin, end, pixel, state, rules):
    """Where the neighbours of the points begin…end are in their frames of reference, how far that is to be trusted, and
    the turns that fit best."""
    away, local = np.empty(3, np.float32), np.empty(3, np.float32)
    rows, w = np.empty(9, np.float32), np.empty(3, np.float32)
    for i in range(begin, end):
        for k in range(state.near.shape[1]):
            j = state.near[i, k]
            state.weight[i, k] = 0
            if j < 0:
                continue
            total, square = np.float32(0), np.float32(0)
            mean = np.zeros(3, np.float32)
            for t in range(
                max(state.window[i, 0], state.window[j, 0]), min(state.window[i, 1], state.window[j, 1]) + 1
            ):
                trust = state.seen[i, t] * state.seen[j, t] + rules.unseen
                for c in range(3):
                    away[c] = state.position[j, t, c] - state.position[i, t, c]
                _rotate(state.rotation[i, t], away, np.float32(-1), local)
                total += trust
                for c in range(3):
                    mean[c] += trust * local[c]
                    square += trust * local[c] ** 2
            if total > 0:
                for c in range(3):
                    mean[c] /= total
                    state.shape[i, k, c] = mean[c]
                    square -= total * mean[c] ** 2
                loose = max(square, np.float32(0)) / total / (rules.loose * pixel) ** 2
                state.weight[i, k] = 1 / (1 + loose) ** 2
        for t in range(state.window[i, 0], state.window[i, 1] + 1):
            rows[:] = 0
            size = np.float32(0)
            for k in range(state.near.shape[1]):
                j, much = state.near[i, k], state.weight[i, k]
                if j < 0 or t < state.window[j, 0] or t > state.window[j, 1]:
                    continue
                _rotate(state.rotation[i, t], state.shape[i, k], np.float32(1), local)
                for c in range(3):
                    away[c] = state.position[j, t, c] - state.position[i, t, c]
                x, y, z = local[0], local[1], local[2]
                rows[0] += much * (y * y + z * z)
                rows[1] -= much * x * y
                rows[2] += much * (x * x + z * z)
                rows[3] -= much * x * z
                rows[4] -= much * y * z
                rows[5] += much * (x * x + y * y)
                rows[6] += much * (y * away[2] - z * away[1])
                rows[7] += much * (z * away[0] - x * away[2])
                rows[8] += much * (x * away[1] - y * away[0])
                size += much * (x * x + y * y + z * z)
            if size > 0:
                solve(rows, np.float32(0.05) * size + np.float32(1e-12), w)
                turn(state.rotation[i, t], w)


@numba.njit(cache=True, nogil=True, fastmath=True)
def _sweep(t, state, rules):
    """Puts the places of frame t right, one point after the other."""
    frames = state.position.shape[1]
    rows, out, a = np.empty(9, np.float32), np.empty(3, np.float32), np.empty(3, np.float32)
    for i in range(len(state.window)):
        if t < state.window[i, 0] or t > state.window[i, 1]:
            continue
        rows[:] = state.depth[i, t]
        for side in range(2):
            g = t + 2 * side - 1
            if g < state.window[i, 0] or g > state.window[i, 1] or g < 0 or g >= frames:
                continue
            step, sign = state.motion[i, min(t, g)], np.float32(1 - 2 * side)
            p = state.position[i, g]
            for c in range(6):
                rows[c] += step[c]
            rows[6] += step[0] * p[0] + step[1] * p[1] + step[3] * p[2] + sign * step[6]
            rows[7] += step[1] * p[0] + step[2] * p[1] + step[4] * p[2] + sign * step[7]
            rows[8] += step[3] * p[0] + step[4] * p[1] + step[5] * p[2] + sign * step[8]
        rigid = np.float32(0)
        for k in range(state.near.shape[1]):
            j = state.near[i, k]
            if j < 0 or t < state.window[j, 0] or t > state.window[j, 1]:
                continue
            much = rules.rigid * state.weight[i, k]
            # The neighbour's turn and the point's own: both say where it is from there.
            _rotate(state.rotation[i, t], state.shape[i, k], np.float32(1), a)
            rigid += much
            for c in range(3):
                rows[6 + c] += much * (state.position[j, t, c] - a[c])
        solve(rows, rigid + np.float32(1e-9), out)
        for c in range(3):
            state.position[i, t, c] = out[c]
