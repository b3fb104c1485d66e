# SPDX-License-Identifier: GPL-3.0-or-later
"""Surface tracks of the open scene: points spread evenly over what can be seen of it from outside, each followed
through the clip with a frame of reference that turns with the surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .outside import seen_from_outside
from .scene.surfaces import Surface, follow_surfaces
from .sequence import Normalisation
from .track_file import SurfaceTracks

FEWEST, MOST = 4_000, 100_000  # points where their number is chosen here
_FEWEST_CANDIDATES, _MOST_CANDIDATES = 40_000, 1_600_000
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
    areas = [_areas(s, pixel) for s in surfaces]
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
        candidates = int(min(candidates * 2 * _CANDIDATES * wanted / seen.sum(), _MOST_CANDIDATES))
    chosen = np.flatnonzero(seen)
    chosen = chosen[np.linspace(0, len(chosen), min(wanted, len(chosen)), endpoint=False).astype(int)]
    return points[chosen], visible / len(chosen)


def _frames_of(surface: Surface) -> np.ndarray:
    return np.unique(np.linspace(surface.first, surface.last, _LOOKS).round().astype(int))


def _areas(surface: Surface, pixel: float) -> np.ndarray:
    """(T,) float64: a triangle's mean area over some frames; a strand's segment is at least a pixel wide."""
    total = np.zeros(len(surface.corners))
    frames = _frames_of(surface)
    for frame in frames:
        a, b, c = (surface.at(frame)[surface.corners[:, i]].astype(np.float64) for i in range(3))
        if surface.radius is None:
            total += np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
        else:
            width = 2 * np.pi * surface.radius[surface.corners[:, :2]].mean(1)
            total += np.linalg.norm(b - a, axis=1) * np.maximum(width, pixel)
    return total / len(frames)


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


def moving_frames(corners: np.ndarray) -> np.ndarray:
    """(F,N,4) float64 unit quaternions w x y z of the frames of triangles (F,N,3,3): x along the first edge, z the
    normal. A segment, its second corner twice, has x along it and turns no more than it must. Each quaternion lies near
    the one before; where a triangle has no area it stays as it was."""
    quaternions = np.empty((*corners.shape[:2], 4))
    turn = _first_frames(corners)
    segment = (corners[:, :, 1] == corners[:, :, 2]).all((0, 2))
    for f in range(len(corners)):
        frame, there = _triangle_frames(corners[f])
        turn = np.where(there[:, None, None], frame, turn)
        if segment.any():
            x, long = _unit(corners[f, :, 1] - corners[f, :, 0])
            along = segment & long
            turn[along] = _least_rotation(turn[along, :, 0], x[along]) @ turn[along]
        q = _quaternions(turn)
        quaternions[f] = q if f == 0 else np.where((q * quaternions[f - 1]).sum(-1, keepdims=True) < 0, -q, q)
    return quaternions


def _triangle_frames(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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
        frame, there = _triangle_frames(at[missing])
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
