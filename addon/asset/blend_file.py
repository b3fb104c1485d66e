# SPDX-License-Identifier: GPL-3.0-or-later
"""An asset as a .blend of its own, to look at: it needs no add-on to be opened, played or rendered.

python -m timesplat.addon.asset.blend_file asset.ply asset.blend
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import bpy

from ...datagen.rigs import CANONICAL, FOV, spherical
from ...datagen.sequence import InputError, Normalisation
from ...model.io.ply import read_ply
from .display import TRANSPARENT_BOUNCES, add_asset, play_clip


def save_blend(path_ply: str | Path, path_blend: str | Path) -> None:
    """Replaces the open file by a scene with the asset, a camera at the front, a sun and a white world, with
    the clip's range and rate, and saves it. It needs no add-on to be opened, played or rendered."""
    asset = read_ply(path_ply)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    add_asset(asset, Path(path_ply).stem)
    play_clip(scene, asset.clip)
    placed = Normalisation(asset.clip.scale, asset.clip.translation)
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    camera.matrix_world = placed.to_world(spherical(CANONICAL["front"], 0)).T.tolist()
    camera.data.angle = math.radians(FOV)
    camera.data.clip_start, camera.data.clip_end = 0.01 * asset.clip.scale, 100 * asset.clip.scale
    sun = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
    sun.rotation_euler = (0.8, 0.2, 0.5)
    for ob in (camera, sun):
        scene.collection.objects.link(ob)
    scene.camera = camera
    scene.world = bpy.data.worlds.new("White")
    scene.world.use_nodes = True
    next(x for x in scene.world.node_tree.nodes if x.type == "BACKGROUND").inputs[0].default_value = (1, 1, 1, 1)
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising = 16, False
    scene.cycles.min_transparent_bounces = TRANSPARENT_BOUNCES  # no roulette: half the noise in equal time
    scene.render.resolution_x = scene.render.resolution_y = 512
    scene.view_settings.view_transform = "Standard"  # others change the asset's colours
    for screen in bpy.data.screens:
        for space in (a.spaces.active for a in screen.areas if a.type == "VIEW_3D"):
            space.shading.type, space.region_3d.view_perspective = "MATERIAL", "CAMERA"
    path = Path(path_blend).resolve()
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        bpy.ops.wm.save_as_mainfile(filepath=str(path), compress=True, copy=True)
    except RuntimeError as e:
        raise InputError(f"{path}: it cannot be written ({' '.join(str(e).split())}).") from None


if __name__ == "__main__":
    try:
        save_blend(*sys.argv[1:3])
    except InputError as error:
        sys.exit(str(error))
