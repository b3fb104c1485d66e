# SPDX-License-Identifier: GPL-3.0-or-later
"""Chooses some of many points on surfaces so that they lie evenly: none close to another, no hole between them. numpy
only."""

from __future__ import annotations

from itertools import product

import numpy as np

_SHRINK = 0.85  # of the distance kept, from round to round
_LEAST = 0.1  # of the first distance: closer points lie on something that is crumpled at this moment
_CROWD = 64  # points in a row of three cells that are looked at: nowhere are so many but where it is crumpled
_AT_ONCE = 50_000  # points whose neighbours are looked at together
_SAME_SIDE = -0.3  # cosine of normals: beyond it two points lie on the two faces of something thin


def spread(
    points: np.ndarray, normals: np.ndarray, group: np.ndarray, area: float, count: int, rng: np.random.Generator
) -> np.ndarray:
    """(n,) sorted indices of `count` of the points (M,3) (all where there are no more), which cover the area.

    Points of one `group` (M,) and one side, by the normals (M,3), keep a distance from each other: darts are thrown
    that must keep it, a large one at first, then smaller ones while some are missing. Normals of 0 have no sides."""
    if count >= len(points):
        return np.arange(len(points))
    radius = first = np.sqrt(area / count)  # of a square patch for each: hardly a pattern of points could keep it
    chosen, priority = np.zeros(len(points), bool), rng.permutation(len(points))
    while True:
        open_ = np.flatnonzero(~chosen)
        blocked = np.zeros(len(points), bool)
        a, b = _close_pairs(points, normals, group, radius)
        blocked[a[chosen[b]]] = blocked[b[chosen[a]]] = True
        both = ~(blocked | chosen)[a] & ~(blocked | chosen)[b]
        added = _first_come(open_[~blocked[open_]], a[both], b[both], priority)
        missing = count - int(chosen.sum())
        if radius < _LEAST * first:
            added = open_
        if len(added) >= missing:
            chosen[added[np.argsort(priority[added])[:missing]]] = True
            return np.flatnonzero(chosen)
        chosen[added] = True
        radius *= _SHRINK


def _first_come(candidates: np.ndarray, a: np.ndarray, b: np.ndarray, priority: np.ndarray) -> np.ndarray:
    """Those candidates that are taken where each keeps out all that come later by priority (lower first) and make a
    pair a[i], b[i] with it."""
    waiting, taken = np.zeros(len(priority), bool), np.zeros(len(priority), bool)
    waiting[candidates] = True
    while waiting.any():
        best = np.full(len(priority), len(priority))
        np.minimum.at(best, a, priority[b])
        np.minimum.at(best, b, priority[a])
        now = waiting & (priority < best)
        taken |= now
        waiting &= ~now
        waiting[a[now[b]]] = waiting[b[now[a]]] = False
        open_ = waiting[a] & waiting[b]
        a, b = a[open_], b[open_]
    return np.flatnonzero(taken)


def _close_pairs(
    points: np.ndarray, normals: np.ndarray, group: np.ndarray, radius: float
) -> tuple[np.ndarray, np.ndarray]:
    """Indices a[i], b[i] of all points of one group and side that are closer than `radius`."""
    low, high = points.min(0), points.max(0)
    size = max(radius, float((high - low).max()) / 2**15)  # numbers of cells fit in 64 bits
    cell = np.floor((points - low) / size).astype(np.int64) + 1
    x, y, z = (cell.max(0) + 2).tolist()
    number = ((group.astype(np.int64) * x + cell[:, 0]) * y + cell[:, 1]) * z + cell[:, 2]
    order = np.argsort(number, kind="stable")
    number, points, normals, group = number[order], points[order], normals[order], group[order]
    pairs = []
    for row, begin in product((0, z, (y - 1) * z, y * z, (y + 1) * z), range(0, len(number), _AT_ONCE)):
        # Cells follow one another along z: three at once, in half of the rows around, and what comes after in its own.
        own = number[begin : begin + _AT_ONCE]
        here = np.arange(begin, begin + len(own))
        start = np.searchsorted(number, own + row - 1, "left") if row else here + 1
        length = np.minimum(np.searchsorted(number, own + row + 1, "right") - start, _CROWD)
        i = np.repeat(here, length)
        j = np.arange(len(i)) + np.repeat(start - np.cumsum(length) + length, length)
        near = ((points[i] - points[j]) ** 2).sum(1) < radius * radius
        i, j = i[near], j[near]
        same = (group[i] == group[j]) & ((normals[i] * normals[j]).sum(1) > _SAME_SIDE)
        pairs.append((order[i[same]], order[j[same]]))
    a, b = (np.concatenate(side) for side in zip(*pairs, strict=True))
    return a, b
