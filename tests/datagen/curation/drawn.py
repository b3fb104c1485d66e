# SPDX-License-Identifier: GPL-3.0-or-later
"""Sequences that are drawn, not rendered: four canonical cameras, whose pictures a function makes."""

import numpy as np

from timesplat.datagen.image_files import write_png
from timesplat.datagen.rigs import CANONICAL, spherical
from timesplat.datagen.sequence import Sequence, View, write_sequence

SIDE = 48


def draw_sequence(folder, paint, frames=6, cameras=tuple(CANONICAL), **provenance):
    """paint(moment 0..1, number of the camera) -> (SIDE,SIDE,4) uint8."""
    seq = Sequence(SIDE, SIDE, 24.0, 0, frames - 1, provenance={"asset": folder.parent.name, **provenance})
    for frame in range(frames):
        for name in cameras:
            c2w = spherical(CANONICAL.get(name, 10.0), 0)
            seq.views.append(View(frame, name, "canonical", c2w, 50.0, 50.0, SIDE / 2, SIDE / 2))

    def fill(root):
        (root / "images").mkdir()
        for n, view in enumerate(seq.views):
            view.image = f"images/{n:03d}.png"
            write_png(root / view.image, paint(view.frame / max(frames - 1, 1), cameras.index(view.camera)))

    return write_sequence(seq, folder, fill)


def box(x=0.5, side=0.4, colour=(200, 120, 40), shade=60, y=0.5):
    """A picture of a shaded square around (x, y), all in sides of the picture."""
    rgba = np.zeros((SIDE, SIDE, 4), np.uint8)
    columns, rows = (np.abs((np.arange(SIDE) + 0.5) / SIDE - centre) < side / 2 for centre in (x, y))
    inside = rows[:, None] & columns[None]
    light = np.clip(np.array(colour)[None, None] + shade * np.linspace(-1, 1, SIDE)[:, None, None], 0, 255)
    light = np.broadcast_to(light, (SIDE, SIDE, 3))
    rgba[inside, :3], rgba[inside, 3] = light[inside].astype(np.uint8), 255
    return rgba
