# SPDX-License-Identifier: GPL-3.0-or-later
"""A static object as a clip: it moves a little from frame to frame along one random direction.

Nothing is moved in Blender. Under suns and a uniform world the picture of an object moved by d, seen by a
camera at c, is the picture of the object at rest, seen from c - d; so the cameras that render are moved
(`counter_moved`), the nominal ones are written, and the motion vectors, which Blender sees as zero, are
computed from depth and displacement (`add_flow`). numpy only.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .passes import Passes
from .rigs import RADIUS, Shot
from .sequence import Normalisation, View, opengl_to_opencv


def displacements(
    normalisation: Normalisation, aabb: np.ndarray, count: int = 24, seed: int = 0
) -> tuple[Normalisation, np.ndarray, np.ndarray]:
    """A seeded motion of a static object whose box is `aabb` (2,3), normalised.

    Direction uniform on the sphere; the whole way is 0.1 to 0.6 of the longest half-side; steps vary by a
    factor of three. Returns the Normalisation and the box over all frames, moved object included, and the
    displacements (count,3) in the new normalised units, of mean zero between first and last. No vertex goes farther
    from the origin than RADIUS.
    """
    rng = np.random.default_rng([seed, 4])
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    steps = np.concatenate([[0.0], rng.uniform(0.5, 1.5, count - 1)])
    way = np.cumsum(steps) / max(steps.sum(), 1e-9) - 0.5
    shift = rng.uniform(0.1, 0.6) * way[:, None] * direction  # old normalised units
    low, high = aabb[0] + shift.min(0), aabb[1] + shift.max(0)
    centre, scale = (low + high) / 2, float((high - low).max() / 2)
    radius = min(RADIUS, float(np.linalg.norm(aabb, axis=1).max()))  # at most, of the object at rest
    scale = max(scale, (radius + float(np.linalg.norm(shift - centre, axis=1).max())) / RADIUS)
    moved = Normalisation(
        normalisation.scale * scale,
        tuple(float(x) for x in np.asarray(normalisation.translation) + normalisation.scale * centre),
    )
    return moved, np.stack([low - centre, high - centre]) / scale, shift / scale


def counter_moved(shots: list[Shot], shift: np.ndarray) -> list[Shot]:
    """The cameras that show the resting object as `shots` would show it moved by shift[frame]."""
    moved = []
    for shot in shots:
        c2w = np.array(shot.c2w, float)
        c2w[:3, 3] -= shift[shot.frame]
        moved.append(replace(shot, c2w=c2w))
    return moved


def add_flow(passes: Passes, view: View, shift: np.ndarray) -> None:
    """Adds to the motion vectors of `view` (the nominal camera) what the displacement does to each pixel;
    before the first and after the last frame of the clip nothing moves."""
    depth = passes.depth
    seen = np.isfinite(depth)
    y, x = np.nonzero(seen)
    z = depth[seen].astype(np.float64)
    ray = np.stack([(x + 0.5 - view.cx) / view.fx, (y + 0.5 - view.cy) / view.fy, np.ones(len(x))], 1)
    points = ray * z[:, None]
    turn = opengl_to_opencv(view.c2w)[:3, :3]
    now = int(view.frame)
    for flow, other in ((passes.flow_next, now + 1), (passes.flow_prev, now - 1)):
        there = min(max(other, 0), len(shift) - 1)
        p = points + (shift[there] - shift[now]) @ turn
        for axis, (focal, start) in enumerate(((view.fx, ray[:, 0]), (view.fy, ray[:, 1]))):
            flow[y, x, axis] += (focal * (p[:, axis] / p[:, 2] - start)).astype(np.float32)
