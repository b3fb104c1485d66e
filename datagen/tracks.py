# SPDX-License-Identifier: GPL-3.0-or-later
"""Surface tracks of the open scene: points spread evenly over what can be seen of it from outside, each followed
through the clip with a frame of reference that turns with the surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .moving_frames import moving_frames, triangle_frames
from .outside import seen_from_outside
from .scene.surfaces import Surface, follow_surfaces
from .sequence import Normalisation
from .spread import spread
from .track_file import SurfaceTracks

FEWEST, MOST = 4_000, 100_000  # points where their number is chosen here
_FEWEST_CANDIDATES, _MOST_CANDIDATES = 80_000, 1_600_000  # what is hidden is told by how densely they lie
_CANDIDATES = 4  # for each point wanted
_LOOKS = 4  # frames of the clip that areas and what is seen are judged by
_R2 = np.array([0.7548776662466927, 0.5698402909980532])  # Roberts' sequence: its first points fill a square evenly
_AT_ONCE = 200_000  # points x frames, see `_moved`


def track_surfaces(
    frames: Sequence[float],
    normalisation: Normalisation,
    pixel: float,
    count: int = 0,
    objects: list | None = None,
    shift: np.ndarray | None = None,
    seed: int = 0,
) -> tuple[SurfaceTracks, list[str]]:
    """Tracks of what the open scene (or these `objects` of it) shows at these scene frames, and the names of the
    objects that are seen and have none (`follow_surfaces`).

    pixel   size of a pixel at the object, normalised units
    count   points; 0: one for each patch of visible surface of a pixel's size, FEWEST to MOST of them
    shift   (F,3) normalised: added to the positions of each frame
    """
    surfaces, untracked = follow_surfaces(frames, normalisation, objects)
    looks = [frames.index(frame) for frame in dict.fromkeys(frames)]
    looks = [looks[i] for i in np.unique(np.linspace(0, len(looks) - 1, _LOOKS).round().astype(int))]
    points, area = _choose(surfaces, looks, pixel, count, np.random.default_rng(seed))
    position, rotation = _moved(surfaces, points, len(frames), shift)
    first, last = (np.array([getattr(s, end) for s in surfaces], np.int32)[points.surface] for end in ("first", "last"))
    return SurfaceTracks(position, rotation, first, last, np.full(len(points), area, np.float32)), untracked


@dataclass(frozen=True)
class _Points:
    """Points of surfaces, sorted by surface."""

    surface: np.ndarray  # (N,) int32, which one
    triangle: np.ndarray  # (N,) int32, of it
    weights: np.ndarray  # (N,3) float32 of the triangle's corners

    def __len__(self) -> int:
        return len(self.surface)

    def __getitem__(self, which: np.ndarray | slice) -> _Points:
        return _Points(self.surface[which], self.triangle[which], self.weights[which])

    def by_surface(self) -> list[tuple[int, slice]]:
        """Number and points of each surface that has any."""
        found, start = np.unique(self.surface, return_index=True)
        return [(int(s), slice(a, b)) for s, a, b in zip(found, start, [*start[1:], len(self)], strict=True)]


def _choose(
    surfaces: list[Surface], looks: list[int], pixel: float, count: int, rng: np.random.Generator
) -> tuple[_Points, float]:
    """The points that are followed, and the area that each stands for."""
    areas, largest = [], []
    for surface in surfaces:
        mean, frame = _areas(surface, pixel)
        areas.append(mean)
        largest.append(frame)
    total = float(sum(a.sum() for a in areas))
    if not total > 0:
        return _Points(np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros((0, 3), np.float32)), 0.0
    patch = max(pixel, 1e-6) ** 2
    candidates = int(np.clip(_CANDIDATES * (count or min(total / patch, MOST)), _FEWEST_CANDIDATES, _MOST_CANDIDATES))
    while True:
        points = _drawn(areas, candidates, rng)
        seen = _seen(surfaces, points, looks, np.sqrt(total / candidates))
        visible = total * seen.mean()
        wanted = count or int(np.clip(visible / patch, FEWEST, MOST))
        if seen.sum() >= 2 * wanted or candidates == _MOST_CANDIDATES:
            break
        candidates = int(min(candidates * 2 * _CANDIDATES * wanted / max(seen.sum(), 1), _MOST_CANDIDATES))
    some = np.flatnonzero(seen)
    some = some[np.linspace(0, len(some), min(_CANDIDATES * wanted, len(some)), endpoint=False).astype(int)]
    points = points[some]
    at, normals = _laid_out(surfaces, largest, points)
    chosen = spread(at, normals, points.surface, visible, wanted, rng)
    return points[chosen], visible / len(chosen)


def _areas(surface: Surface, pixel: float) -> tuple[np.ndarray, int]:
    """(T,) float64: a triangle's mean area over some frames, where a strand's segment is at least a pixel wide; and the
    one of these frames at which all of them are largest."""
    frames = np.unique(np.linspace(surface.first, surface.last, _LOOKS).round().astype(int))
    areas = np.empty((len(frames), len(surface.corners)))
    for i, frame in enumerate(frames):
        vertices = surface.at(frame).astype(np.float64)
        a, b, c = (vertices[surface.corners[:, k]] for k in range(3))
        if surface.radius is None:
            areas[i] = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
        else:
            width = 2 * np.pi * surface.radius[surface.corners[:, :2]].mean(1)
            areas[i] = np.linalg.norm(b - a, axis=1) * np.maximum(width, pixel)
    return areas.mean(0), int(frames[areas.sum(1).argmax()])


def _drawn(areas: list[np.ndarray], count: int, rng: np.random.Generator) -> _Points:
    """`count` points as evenly as can be: one every so much area, along the triangles in their order, and inside a
    triangle by a sequence that fills it evenly."""
    each = np.concatenate(areas)
    ends = np.cumsum(each)
    triangle = np.searchsorted(ends, (np.arange(count) + rng.random()) * (ends[-1] / count), side="right")
    triangle = np.minimum(triangle, len(each) - 1)
    _, first, of = np.unique(triangle, return_index=True, return_inverse=True)
    number = np.arange(count) - first[of]  # of the point in its triangle
    a, b = ((rng.random((len(first), 2))[of] + number[:, None] * _R2) % 1).T
    over = a + b > 1
    a, b = np.where(over, 1 - a, a), np.where(over, 1 - b, b)
    starts = np.cumsum([0, *map(len, areas)])
    surface = np.searchsorted(starts, triangle, side="right") - 1
    weights = np.stack([1 - a - b, a, b], 1).astype(np.float32)
    return _Points(surface.astype(np.int32), (triangle - starts[surface]).astype(np.int32), weights)


def _seen(surfaces: list[Surface], points: _Points, looks: list[int], spacing: float) -> np.ndarray:
    """(M,) bool: which points can be seen from outside at one of the frames `looks`, or at the middle of its surface's
    time where this is at none of them."""
    seen, parts = np.zeros(len(points), bool), points.by_surface()
    middles = {(s.first + s.last) // 2 for s in surfaces if not any(s.first <= f <= s.last for f in looks)}
    for frame in sorted({*looks, *middles}):
        there = [(surfaces[s], part) for s, part in parts if surfaces[s].first <= frame <= surfaces[s].last]
        if there:
            at = np.concatenate([_positions(surface.at(frame), surface, points[part]) for surface, part in there])
            which = np.concatenate([np.arange(part.start, part.stop) for _, part in there])
            seen[which] |= seen_from_outside(at, spacing)
    return seen


def _laid_out(surfaces: list[Surface], frames: list[int], points: _Points) -> tuple[np.ndarray, np.ndarray]:
    """(M,3) float32 each: where the points and their normals are at the frame of each surface."""
    at, normals = np.empty((len(points), 3), np.float32), np.zeros((len(points), 3), np.float32)
    for s, part in points.by_surface():
        surface, own = surfaces[s], points[part]
        vertices = surface.at(frames[s])
        at[part] = _positions(vertices, surface, own)
        if surface.radius is None:
            turn, there = triangle_frames(vertices[surface.corners[own.triangle]])
            normals[part] = np.where(there[:, None], turn[..., 2], 0)
    return at, normals


def _positions(vertices: np.ndarray, surface: Surface, points: _Points) -> np.ndarray:
    """(n,3) float32 of points of one surface whose vertices (V,3) are there."""
    return np.einsum("nk,nkd->nd", points.weights, vertices[surface.corners[points.triangle]])


# ---------------------------------------------------------------- through the clip


def _moved(
    surfaces: list[Surface], points: _Points, frames: int, shift: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Positions (N,F,3) float32 and rotations (N,F,4) float16 of the points at each frame."""
    position = np.empty((len(points), frames, 3), np.float32)
    rotation = np.empty((len(points), frames, 4), np.float16)
    step = max(1, _AT_ONCE // frames)
    for start in range(0, len(points), step):
        some, part = slice(start, start + step), points[start : start + step]
        corners = np.empty((frames, len(part), 3, 3), np.float32)
        moved = np.zeros((frames, len(part), 3), np.float32)
        for s, own in part.by_surface():
            surface = surfaces[s]
            there = np.clip(np.arange(frames), surface.first, surface.last)
            moments = surface.moments[there - surface.first, None, None]
            corners[:, own] = surface.vertices[moments, surface.corners[part.triangle[own]]]
            if shift is not None:
                moved[:, own] = shift[there, None]
        at = np.einsum("nk,fnkd->fnd", part.weights, corners) + moved
        position[some] = at.transpose(1, 0, 2)
        rotation[some] = moving_frames(corners.astype(np.float64)).transpose(1, 0, 2)
    return position, rotation
