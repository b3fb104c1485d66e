# SPDX-License-Identifier: GPL-3.0-or-later
"""Shapes and rigid motions of the procedural zoo: numpy only.

A shape is `(points, faces)`: points of shape (V, 3), or (F, V, 3) where they differ from frame to frame,
and faces as lists of indices. Leading axes broadcast everywhere, so one call poses all frames of a clip.
"""

from __future__ import annotations

import numpy as np

X, Y, Z = np.eye(3)


def rotation(axis, angle) -> np.ndarray:
    """4×4 rotations about `axis` by `angle` (any shape) in radians."""
    x, y, z = np.asarray(axis, float) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.asarray(angle, float)[..., None, None]
    matrix = np.zeros((*angle.shape[:-2], 4, 4))
    matrix[..., :3, :3] = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    matrix[..., 3, 3] = 1
    return matrix


def translation(offset) -> np.ndarray:
    """4×4 translations by `offset` of shape (..., 3)."""
    offset = np.asarray(offset, float)
    matrix = np.broadcast_to(np.eye(4), (*offset.shape[:-1], 4, 4)).copy()
    matrix[..., :3, 3] = offset
    return matrix


def scaling(factors) -> np.ndarray:
    """4×4 scalings by `factors` of shape (..., 3)."""
    factors = np.asarray(factors, float)
    return np.concatenate([factors, np.ones((*factors.shape[:-1], 1))], -1)[..., None] * np.eye(4)


def apply(matrix, points) -> np.ndarray:
    """Transform points (..., V, 3) by matrices (..., 4, 4)."""
    return points @ np.swapaxes(matrix[..., :3, :3], -1, -2) + matrix[..., None, :3, 3]


def unit(vectors) -> np.ndarray:
    """Vectors at length 1; a null vector stays null."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)


def spline(knots: int, per: int) -> np.ndarray:
    """Catmull-Rom weights (samples, knots): `weights @ points` is a smooth curve through the points."""
    at = np.linspace(0, knots - 1, (knots - 1) * per + 1)
    left = np.minimum(at.astype(int), max(knots - 2, 0))
    f = at - left
    basis = (-f + 2 * f**2 - f**3, 2 - 5 * f**2 + 3 * f**3, f + 4 * f**2 - 3 * f**3, f**3 - f**2)
    weights = np.zeros((len(at), knots))
    for shift, column in zip((-1, 0, 1, 2), basis, strict=True):
        np.add.at(weights, (np.arange(len(at)), np.clip(left + shift, 0, knots - 1)), column / 2)
    return weights


def on_blob(direction, size, power: float = 2) -> np.ndarray:
    """Where a ray from a blob's centre leaves it."""
    direction, size = np.asarray(direction, float), np.asarray(size, float)
    norm = (np.abs(direction / size) ** power).sum(-1, keepdims=True) ** (1 / power)
    return direction / norm


def blob(size, power: float = 2, n: int = 6):
    """A superquadric on a cube's grid: half sizes `size`; power 2 is an ellipsoid, 1 an octahedron, 8 a
    box with bevelled edges. A grid of squares has no poles, so it deforms and shades evenly."""
    lattice = np.stack(np.meshgrid(*[np.arange(n + 1)] * 3, indexing="ij"), -1).reshape(-1, 3)
    lattice = lattice[((lattice == 0) | (lattice == n)).any(1)]
    number = -np.ones((n + 1,) * 3, int)
    number[tuple(lattice.T)] = np.arange(len(lattice))
    faces = []
    for axis in range(3):
        for side in (0, n):
            grid = np.take(number, side, axis)
            # Outward on all six sides: the order turns with the side and with the middle axis.
            faces.append(_quads(grid if (side == n) == (axis != 1) else grid.T))
    points = on_blob(np.tan((lattice / n - 0.5) * np.pi / 2), np.ones(3), power)
    return points * np.asarray(size, float), np.concatenate(faces).tolist()


def tube(points, radii, ref=(0, 0, 1), sides: int = 10, cap: float = 1.0, outline=None):
    """A closed tube along `points` (..., n, 3). `radii` (n) or (n, 2): along tangent × ref, and along ref.
    `cap` is the height of the end caps over their radius; `outline` (k, 2) replaces the circle."""
    points, radii = np.asarray(points, float), np.asarray(radii, float)
    radii = np.maximum(np.repeat(radii[:, None], 2, 1) if radii.ndim == 1 else radii, 1e-3)
    tangent = unit(np.gradient(points, axis=-2))
    centres, scales, along = [points], [radii], [tangent]
    poles = []
    for end, sign in ((0, -1), (-1, 1)):
        height = sign * cap * radii[end].mean() * tangent[..., end, :]
        poles.append(points[..., end, :] + height)
        for angle in (0.7, 1.25) if cap > 0.3 else (1.1,):
            ring = (points[..., end, :] + height * np.sin(angle))[..., None, :]
            place = 0 if end == 0 else len(centres)
            centres.insert(place, ring)
            scales.insert(place, radii[end : end + 1 or None] * np.cos(angle))
            along.insert(place, tangent[..., end, None, :])
    centre, scale, along = np.concatenate(centres, -2), np.concatenate(scales), np.concatenate(along, -2)
    across = unit(np.cross(along, np.asarray(ref, float)))
    upward = np.cross(across, along)
    if outline is None:
        angle = np.arange(sides) * 2 * np.pi / sides + np.pi / sides
        outline = np.stack([np.cos(angle), np.sin(angle)], 1)
    step = outline * scale[:, None, :]
    rings = centre[..., None, :] + step[..., :1] * across[..., None, :] + step[..., 1:] * upward[..., None, :]
    count, sides = len(scale), len(outline)
    grid = np.arange(count * sides).reshape(count, sides)
    grid = np.concatenate([grid, grid[:, :1]], 1)
    faces = _quads(grid).tolist()
    first, last = count * sides, count * sides + 1
    faces += [[first, a, b] for a, b in zip(grid[0], grid[0, 1:], strict=False)]
    faces += [[last, b, a] for a, b in zip(grid[-1], grid[-1, 1:], strict=False)]
    rings = rings.reshape(*rings.shape[:-3], -1, 3)
    return np.concatenate([rings, np.stack(poles, -2)], -2), faces


def torus(radius: float, thickness: float, n: int = 20, m: int = 8):
    """A ring in the xy plane."""
    a, b = np.meshgrid(np.arange(n) * 2 * np.pi / n, np.arange(m) * 2 * np.pi / m, indexing="ij")
    r = radius + thickness * np.cos(b)
    points = np.stack([r * np.cos(a), r * np.sin(a), thickness * np.sin(b)], -1).reshape(-1, 3)
    grid = np.arange(n * m).reshape(n, m)
    return points, _quads(np.pad(grid, ((0, 1), (0, 1)), "wrap")).tolist()


def sheet(points):
    """A thin surface through a grid of points (..., nu, nv, 3)."""
    *lead, nu, nv, _ = points.shape
    return points.reshape(*lead, nu * nv, 3), _quads(np.arange(nu * nv).reshape(nu, nv)).tolist()


def gear_outline(teeth: int, depth: float = 0.2) -> np.ndarray:
    """The outline of a cogwheel, or of a star when the depth is large."""
    angle = np.arange(teeth * 4) * 2 * np.pi / (teeth * 4)
    radius = np.tile([1, 1, 1 - depth, 1 - depth], teeth)
    return radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)


def lumpy(points, rng, amount: float, frequency: float = 3.0) -> np.ndarray:
    """Displace a surface about its origin by a few random plane waves: rocks, fur, crumpled dough."""
    waves = rng.normal(size=(6, 3)) * frequency
    noise = np.sin(points @ waves.T + rng.uniform(0, 6.3, 6)).mean(-1, keepdims=True)
    return points * (1 + amount * 2 * noise)


def _quads(grid: np.ndarray) -> np.ndarray:
    corners = (grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:])
    return np.stack(corners, -1).reshape(-1, 4)
