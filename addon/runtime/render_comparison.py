# SPDX-License-Identifier: GPL-3.0-or-later
"""Renders a comparison by Cycles, in a background Blender (`background_blender`): what an asset was made from, the
asset, and their difference; as the capture rendered it: with Even Light where that was on, over white, colours as they
are. The request:
asset, originals, lights   names of objects     even   Even Light, in place of the lights
view       None (the scene's camera), or a camera as `data`, `matrix`, `width` and `height`
size       pixels of the longer side            samples   Cycles samples a pixel of the original
"""

from __future__ import annotations

import math
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix

from ...datagen.blender_output import read_multilayer, to_straight_srgb
from ...datagen.render_setup import CaptureSettings, add_even_light, apply_settings, temporary_data
from ...datagen.scene.borrow import borrowed
from ..asset.display import TRANSPARENT_BOUNCES
from ..asset.sliders import asset_modifier, set_input
from . import background_blender

SPLAT_SAMPLES = 2  # splats are smooth and glow by themselves: more samples change next to nothing
GAIN = 4  # the difference is shown this many times as strong


def compare(request: dict, progress) -> dict:
    """Writes compared.npy, (height, 3 · width, 3) float32, sRGB-encoded, rows from the top: what the asset was made
    from, the asset, GAIN times their absolute difference; returns the PSNR in dB over the whole picture."""
    scene = bpy.context.scene
    chosen = {key: [scene.objects[n] for n in request[key]] for key in ("originals", "lights")}
    view = _camera(scene, request["view"])
    progress(0.1, "rendering the original")
    truth = _picture(scene, [*chosen["originals"], *chosen["lights"]], view, request, request["samples"])
    progress(0.6, "rendering the reconstruction")
    asset = _picture(scene, [scene.objects[request["asset"]]], view, request, SPLAT_SAMPLES)
    np.save("compared.npy", np.concatenate([truth, asset, np.minimum(GAIN * np.abs(truth - asset), 1)], 1))
    error = float(((truth - asset) ** 2).mean())
    return {"psnr": min(-10 * math.log10(max(error, 1e-12)), 120.0)}


def _camera(scene, view: dict | None) -> tuple:
    """(camera, its matrix in the world, width, height in any unit)."""
    if not view:
        render = scene.render
        data, matrix = scene.camera.data, scene.camera.matrix_world.copy()
        return data, matrix, render.resolution_x * render.pixel_aspect_x, render.resolution_y * render.pixel_aspect_y
    data = bpy.data.cameras.new("timesplat")
    for key, value in view["data"].items():
        setattr(data, key, value)
    return data, Matrix(view["matrix"]), view["width"], view["height"]


def _picture(scene, objects: list, view: tuple, request: dict, samples: int) -> np.ndarray:
    """(H,W,3) float32, sRGB-encoded, over white: the objects, shown whether or not they are hidden."""
    data, matrix, width, height = view
    scale = request["size"] / max(width, height)
    width, height = max(1, round(width * scale)), max(1, round(height * scale))
    for ob in objects:
        ob.hide_render = False
        if modifier := asset_modifier(ob):
            set_input(modifier, "Look", "Splats")
    with borrowed(objects, lights=not request["even"]) as stage, temporary_data() as made:
        apply_settings(stage, CaptureSettings((width, height), samples, passes=False))
        if request["even"]:
            add_even_light(stage, made)
        stage.render.use_multiview = False
        stage.cycles.transparent_max_bounces = TRANSPARENT_BOUNCES
        stage.cycles.min_transparent_bounces = TRANSPARENT_BOUNCES  # no roulette: less noise
        camera = bpy.data.objects.new("timesplat", data)
        made.append(camera)
        camera.matrix_world = matrix
        stage.collection.objects.link(camera)
        stage.camera = camera
        stage.frame_set(scene.frame_current, subframe=scene.frame_subframe)
        stage.render.filepath = str(Path.cwd() / "frame")
        with bpy.context.temp_override(scene=stage):
            bpy.ops.render.render(write_still=True)
    rgba = to_straight_srgb(read_multilayer(Path("frame.exr"))["combined"]) / np.float32(255)
    return rgba[..., :3] * rgba[..., 3:] + (1 - rgba[..., 3:])


if __name__ == "__main__":
    background_blender.serve(compare)
