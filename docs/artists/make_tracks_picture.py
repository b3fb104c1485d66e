# SPDX-License-Identifier: GPL-3.0-or-later
"""Makes tracks.png, in a Python that has the bpy wheel and timesplat[torch]:

    python docs/artists/make_tracks_picture.py ASSET CLIP OUT.png

An animated asset beside its reconstruction by the presets Balanced and Fine (columns), at two moments of a clip (rows),
as `timesplat.compare` renders them: 512 pixels, even light, white, the view transform Standard."""

import math
import os
import sys
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix
from PIL import Image

import timesplat.addon
from timesplat.datagen import rigs
from timesplat.datagen.scene.clips import play
from timesplat.datagen.scene.measure import normalisation
from timesplat.datagen.scene.open import open_asset

SIZE, MOMENTS, MARGIN = 512, (0.3, 0.8), 8
AROUND, ABOVE, FIELD_OF_VIEW = 40, 14, 46  # degrees: a view between those that the presets take pictures from


def main(path: str, name: str, out: str) -> None:
    os.environ.setdefault("TIMESPLAT_PYTHON", sys.executable)
    opened = open_asset(Path(path))
    clip = next(c for c in opened.clips if c.name == name)
    play(clip, opened.rest)
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = clip.frame_start, clip.frame_end
    timesplat.addon.register()
    norm, _ = normalisation(list(range(clip.frame_start, clip.frame_end + 1)), name=path)

    columns = []
    for preset in ("BALANCED", "FINE"):
        bpy.ops.timesplat.preset(preset=preset)
        chosen = {key: getattr(scene.timesplat, key) for key in ("size", "samples", "method", "budget", "refine")}
        bpy.ops.timesplat.reconstruct(**chosen)
        asset = bpy.context.object
        scene.camera = camera(norm)
        for ob in scene.objects:
            ob.select_set(ob == asset)
        columns.append([compared(scene, moment) for moment in MOMENTS])
        bpy.data.objects.remove(scene.camera)  # else it would be one of those that take the pictures
        asset.hide_render = True
    originals = [pair[0] for pair in columns[0]]
    rows = zip(originals, *([pair[1] for pair in column] for column in columns), strict=True)
    picture(list(rows)).save(out, optimize=True)


def camera(norm):
    """A camera that looks at the middle of the clip's box."""
    ob = bpy.data.objects.new("View", bpy.data.cameras.new("View"))
    bpy.context.scene.collection.objects.link(ob)
    ob.matrix_world = Matrix(norm.to_world(rigs.spherical(AROUND, ABOVE)).tolist())
    ob.data.angle = math.radians(FIELD_OF_VIEW)
    return ob


def compared(scene, moment: float) -> tuple[np.ndarray, np.ndarray]:
    """The original and the active asset at a moment 0..1 of the clip, (SIZE,SIZE,3) each."""
    scene.render.resolution_x = scene.render.resolution_y = SIZE
    scene.frame_set(round(scene.frame_start + moment * (scene.frame_end - scene.frame_start)))
    bpy.ops.timesplat.compare(size=SIZE, samples=32)
    image = bpy.data.images["Timesplat Compare"]
    pixels = np.array(image.pixels, np.float32).reshape(SIZE, 3 * SIZE, 4)[::-1, :, :3]
    return pixels[:, :SIZE], pixels[:, SIZE : 2 * SIZE]


def picture(rows: list[tuple[np.ndarray, ...]]) -> Image.Image:
    """All of them side by side, cut to what any of a row shows."""
    lines = []
    for row in rows:
        shown = np.logical_or.reduce([cell.min(-1) < 0.98 for cell in row])
        (y0, y1), (x0, x1) = ((a.min(), a.max() + 1) for a in map(np.flatnonzero, (shown.any(1), shown.any(0))))
        cut = [np.pad(c[y0:y1, x0:x1], ((MARGIN,) * 2, (MARGIN,) * 2, (0, 0)), constant_values=1) for c in row]
        lines.append(np.concatenate(cut, 1))
    widest = max(line.shape[1] for line in lines)
    lines = [np.pad(x, ((0, 0), (0, widest - x.shape[1]), (0, 0)), constant_values=1) for x in lines]
    return Image.fromarray((np.concatenate(lines).clip(0, 1) * 255).round().astype(np.uint8))


if __name__ == "__main__":
    main(*sys.argv[1:])
