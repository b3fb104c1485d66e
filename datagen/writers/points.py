# SPDX-License-Identifier: GPL-3.0-or-later
"""Points to start a fit from, which some programs ask for: of the silhouettes' hull, in the colours seen there."""

from __future__ import annotations

import numpy as np

from ..readers import volume
from ..readers.placing import looked_at, silhouettes_of
from ..sequence import Sequence, opengl_to_opencv

MOST = 5000
COLOURED_BY = 12  # views


def start_points(seq: Sequence) -> tuple[np.ndarray, np.ndarray]:
    """(P,3) normalised, and (P,3) uint8. Where silhouettes leave nothing: random points in the object's box. Always the
    same of a Sequence. Raises InputError for a picture that cannot be read."""
    rng = np.random.default_rng(0)
    sil = silhouettes_of(seq)
    hull = volume.hull_of(sil) if sil.masks.any() else None
    low, high = np.array(seq.aabb, float)
    points = rng.uniform(low, high, (MOST, 3)) if hull is None else hull.occupied
    points = points[rng.permutation(len(points))[:MOST]]
    views, _ = looked_at(seq)
    total, count = np.zeros((len(points), 3)), np.zeros((len(points), 1))
    for i in np.array(views)[np.unique(np.linspace(0, len(views) - 1, COLOURED_BY).round().astype(int))]:
        v, rgba = seq.views[i], seq.load_image(int(i))
        c2w = opengl_to_opencv(v.c2w)
        x, y, z = ((points - c2w[:3, 3]) @ c2w[:3, :3]).T
        with np.errstate(all="ignore"):
            column, row = np.floor(x / z * v.fx + v.cx), np.floor(y / z * v.fy + v.cy)
        there = (z > 0) & (column >= 0) & (row >= 0) & (column < seq.width) & (row < seq.height)
        seen = rgba[row[there].astype(int), column[there].astype(int)].astype(float)
        total[there] += seen[:, :3] * seen[:, 3:]
        count[there] += seen[:, 3:]
    colours = np.where(count > 0, total / np.maximum(count, 1), 128)
    return points, np.rint(colours).astype(np.uint8)
