# SPDX-License-Identifier: GPL-3.0-or-later
"""Renders a comparison by Cycles, in a background Blender (`background_blender`): what an asset was made from, the
asset, and their difference; as the capture rendered it: with Studio Lighting where that was on, over white, colours as
they are. The request:
asset, originals, lights   names of objects     even   Studio Lighting, in place of the lights
view       None (the scene's camera), or a camera as `data`, `matrix`, `width` and `height`
size       pixels of the longer side            samples   Cycles samples a pixel of the original
frames     others than the present one, to look for the worst at a part of the size
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
SMALLER = 2  # the other frames are rendered at the size divided by this


def compare(request: dict, progress) -> dict:
    """Writes compared.npy, (height, 3 · width, 3) float32, sRGB-encoded, rows from the top: what the asset was made
    from, the asset, GAIN times their absolute difference. Returns PSNRs in dB: `psnr` over the whole picture, `inside`
    over the pixels that either of them covers, and `frames`, the latter of each frame in which there are any."""
    scene = bpy.context.scene
    chosen = {key: [scene.objects[n] for n in request[key]] for key in ("originals", "lights")}
    camera = _camera(scene, request["view"])
    frames, now = request["frames"], (scene.frame_current, scene.frame_subframe)

    def pair(frame: int, subframe: float, size: int, done: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Both pictures, and which pixels they cover."""
        taken, at, view = request | {"size": size}, (frame, subframe), camera
        if not request["view"]:
            scene.frame_set(frame, subframe=subframe)  # for the camera may move
            view = (view[0], scene.camera.matrix_world.copy(), *view[2:])
        progress(done, f"rendering the original at frame {frame}")
        truth, cover = _picture(scene, [*chosen["originals"], *chosen["lights"]], view, taken, request["samples"], at)
        progress(done + 0.5 / (len(frames) + 1), f"rendering the reconstruction at frame {frame}")
        asset, covered = _picture(scene, [scene.objects[request["asset"]]], view, taken, SPLAT_SAMPLES, at)
        return truth, asset, np.maximum(cover, covered)[..., 0] > 0.5

    truth, asset, inside = pair(*now, request["size"], 0.1)
    np.save("compared.npy", np.concatenate([truth, asset, np.minimum(GAIN * np.abs(truth - asset), 1)], 1))
    told = {"psnr": _psnr(truth, asset), "inside": _psnr(truth[inside], asset[inside]) if inside.any() else None}
    scores = {now[0]: told["inside"]}
    for i, frame in enumerate(frames):
        one, other, covered = pair(frame, 0.0, max(request["size"] // SMALLER, 16), (i + 1.1) / (len(frames) + 1.2))
        scores[frame] = _psnr(one[covered], other[covered]) if covered.any() else None
    return told | {"frames": {frame: score for frame, score in scores.items() if score is not None}}


def _psnr(a: np.ndarray, b: np.ndarray) -> float:
    return min(-10 * math.log10(max(float(((a - b) ** 2).mean()), 1e-12)), 120.0)


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


def _picture(
    scene, objects: list, view: tuple, request: dict, samples: int, at: tuple[int, float]
) -> tuple[np.ndarray, np.ndarray]:
    """(H,W,3) float32, sRGB-encoded, over white, and (H,W,1) alpha: the objects at a frame and subframe, shown
    whether or not they are hidden."""
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
        stage.frame_set(at[0], subframe=at[1])
        stage.render.filepath = str(Path.cwd() / "frame")
        with bpy.context.temp_override(scene=stage):
            bpy.ops.render.render(write_still=True)
    rgba = to_straight_srgb(read_multilayer(Path("frame.exr"))["combined"]) / np.float32(255)
    return rgba[..., :3] * rgba[..., 3:] + (1 - rgba[..., 3:]), rgba[..., 3:]


if __name__ == "__main__":
    background_blender.serve(compare)
