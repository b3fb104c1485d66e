# SPDX-License-Identifier: GPL-3.0-or-later
"""Renders chosen (camera, frame) pairs of the open Blender scene into a Sequence.

The command line and the add-on both come here. Nothing of the scene is moved, keyed or changed: the work is
done in a throw-away copy of it (`scene.borrowed`), the cameras are placed in world space through the
normalisation, and depth is divided by its scale. All the cameras of a frame are one multi-view render, which
gives picture, depth and motion vectors at once.
"""

from __future__ import annotations

import contextlib
import math
import re
import struct
import tempfile
from collections.abc import Callable, Iterator
from itertools import groupby
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix, Vector

from . import displace
from .image_files import read_exr, write_png
from .rigs import Shot
from .scene import borrowed
from .sequence import (
    InputError,
    Normalisation,
    Passes,
    Sequence,
    View,
    distinct,
    focal_from_fov,
    write_passes,
    write_sequence,
)

BACKGROUND = 1e9  # Blender writes 1e10 where a pixel's depth sample met nothing
SUNS = (  # direction the light comes from, irradiance: a key, a fill and a light from behind
    ((-1.0, -1.2, 1.6), 1.5),
    ((1.4, -0.7, 0.5), 0.6),
    ((0.4, 1.5, 0.9), 0.9),
)
WORLD = 0.45  # radiance of the uniform world: albedo 1 in full shade shows as this


def capture(
    shots: list[Shot],
    out: Path,
    *,
    frames: list[int],
    normalisation: Normalisation,
    size: int | tuple[int, int] = 128,
    samples: int = 16,
    passes: bool = True,
    linear: bool = False,
    engine: str = "CYCLES",
    device: str = "CPU",
    threads: int = 0,
    lighting: bool = True,
    objects: list | None = None,
    seed: int = 0,
    aabb: np.ndarray | None = None,
    provenance: dict | None = None,
    shift: np.ndarray | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Sequence:
    """Renders `shots` of the open scene and writes the Sequence `out`; returns it as read back.

    shots           cameras in normalised space; `Shot.frame` counts the clip's frames, 0…len(frames)-1
    frames          the scene frame of each frame of the clip, evenly apart (the clip's rate is the scene's over that);
                    may repeat one (a padded clip holds still)
    size            pixels, an int for a square image or (width, height)
    passes          also write depth and motion vectors; `linear` adds the scene-linear picture to them
    device          Cycles' "CPU" or "GPU" (the one chosen in Blender's preferences); threads 0 = all cores
    lighting        three suns and a grey world in place of the scene's own lights and world
    objects         Blender objects that the cameras see; None = all that the scene shows to renders
    shift           (F,3) normalised: show the scene moved by this at each frame of the clip (`displace`)
    progress        called with (images done, images in all) after every frame

    Motion vectors hold for a camera that stands still, and for one step of `frames`: where two entries are
    n scene frames apart, they are n times what Blender says of one scene frame.
    Raises InputError where there is nothing to render. Values that an artist changed without keying them
    are lost, as after every animation render in Blender; everything else is as before.
    """
    if not shots:
        raise InputError(f"{out}: there is no camera to render; choose a rig and at least one frame.")
    width, height = (size, size) if isinstance(size, int) else size
    taken = shots if shift is None else displace.counter_moved(shots, shift)
    order = sorted(range(len(shots)), key=lambda i: shots[i].frame)  # each frame is evaluated once
    scene = bpy.context.scene
    seq = Sequence(
        width=width,
        height=height,
        fps=scene.render.fps / scene.render.fps_base / _step(frames),
        frame_start=0,
        frame_end=len(frames) - 1,
        normalisation=normalisation,
        aabb=[[-1.0] * 3, [1.0] * 3] if aabb is None else np.asarray(aabb, float).tolist(),
        provenance=dict(provenance or {}),
        views=[_view(shots[i], width, height) for i in order],
    )

    def fill(folder: Path) -> None:
        (folder / "images").mkdir()
        (folder / "passes").mkdir() if passes else None
        with contextlib.ExitStack() as stack:
            tmp = Path(stack.enter_context(tempfile.TemporaryDirectory(ignore_cleanup_errors=True)))
            stage = stack.enter_context(borrowed(objects, lights=not lighting))
            made = stack.enter_context(temporary())
            render_settings(stage, width, height, samples, passes, engine, device, threads)
            if lighting:
                even_light(stage, made)
            cameras = _Cameras(stage, made, normalisation)
            eyes = list(dict.fromkeys((s.rig, s.camera) for s in shots))
            plain = ["_".join(re.sub(r"[^A-Za-z0-9-]+", "-", text) or "0" for text in who) for who in eyes]
            done, slugs = 0, dict(zip(eyes, distinct(plain), strict=True))
            for frame, group in groupby(order, key=lambda i: shots[i].frame):
                stage.frame_set(frames[frame])
                if engine == "CYCLES":
                    stage.cycles.seed = seed + frame
                cameras.place([taken[i] for i in group])
                for file in cameras.render(tmp):
                    view = seq.views[done]
                    name = f"{slugs[view.rig, view.camera]}_{view.frame:04d}"
                    try:
                        channels = read_multilayer(file)
                    except (ValueError, OSError, struct.error, IndexError, KeyError):
                        raise InputError(
                            f"{tmp}: Blender did not write the picture whole; make space on that disk."
                        ) from None
                    view.image = f"images/{name}.png"
                    write_png(folder / view.image, straight_srgb(channels["combined"]))
                    if passes:
                        view.passes = f"passes/{name}.exr"
                        p = to_passes(channels, normalisation.scale)
                        _per_step(p, frames, frame)
                        if shift is not None:
                            displace.add_flow(p, view, shift)
                        write_passes(folder / view.passes, p, channels["combined"] if linear else None)
                    done += 1
                progress(done, len(shots))

    return write_sequence(seq, out, fill)


def read_multilayer(path: Path) -> dict[str, np.ndarray]:
    """Blender's EXR of one view: "combined" (H,W,4) scene-linear premultiplied RGBA and, where rendered,
    "z" (H,W) and "vector" (H,W,4), all float32, rows from the top."""
    # Blender 5 writes a part per pass, older ones a single part; the channels' names end alike
    by_end = {".".join(k.split(".")[-2:]): v.astype(np.float32) for k, v in read_exr(path).items()}
    found = {"combined": np.stack([by_end[f"Combined.{c}"] for c in "RGBA"], -1)}
    if "Depth.Z" in by_end:
        found["z"] = by_end["Depth.Z"]
    if "Vector.X" in by_end:
        found["vector"] = np.stack([by_end[f"Vector.{c}"] for c in "XYZW"], -1)
    return found


def to_passes(channels: dict[str, np.ndarray], scale: float) -> Passes:
    """Blender's conventions to ours. Depth is Cycles' first sample of the pixel, not filtered: it is a
    surface's or the background's, never a mixture. Blender's vectors are y up, XY leads back from now to the
    frame before, ZW from the frame after back to now."""
    z, vector = channels["z"], channels["vector"]
    depth = np.where(z < BACKGROUND, z / np.float32(scale), np.float32(np.inf))
    down = np.array([1, -1], np.float32)
    return Passes(depth, -vector[..., 2:] * down, vector[..., :2] * down)


def straight_srgb(linear: np.ndarray) -> np.ndarray:
    """(…,4) scene-linear premultiplied -> (…,4) uint8 straight alpha, sRGB-encoded ("Standard" view)."""
    alpha = np.clip(linear[..., 3:], 0, 1)
    rgb = np.clip(linear[..., :3] / np.maximum(alpha, 1e-6), 0, 1)
    rgb = np.where(rgb <= 0.0031308, 12.92 * rgb, 1.055 * rgb ** (1 / 2.4) - 0.055)
    rgba = np.round(np.concatenate([rgb, alpha], -1) * 255).astype(np.uint8)
    rgba[rgba[..., 3] == 0] = 0
    return rgba


def _step(frames: list[int]) -> int:
    """Scene frames between two frames of a clip: 1 where there is but one, or they do not go on."""
    return max(frames[1] - frames[0], 1) if len(frames) > 1 else 1


def _per_step(passes: Passes, frames: list[int], i: int) -> None:
    """Motion per scene frame -> motion per frame of the clip; a padded frame holds still."""
    passes.flow_next *= frames[i + 1] - frames[i] if i + 1 < len(frames) else 1
    passes.flow_prev *= frames[i] - frames[i - 1] if i > 0 else 1


def _view(shot: Shot, width: int, height: int) -> View:
    side = max(width, height)
    focal = focal_from_fov(shot.fov, side)
    cx, cy = width / 2 - shot.shift[0] * side, height / 2 + shot.shift[1] * side
    return View(shot.frame, shot.camera, shot.rig, shot.c2w, focal, focal, cx, cy)


# ---------------------------------------------------------------- the borrowed scene


@contextlib.contextmanager
def temporary() -> Iterator[list]:
    """A list of data-blocks that are removed at the end."""
    made: list = []
    try:
        yield made
    finally:
        bpy.data.batch_remove(made)


def render_settings(stage, width, height, samples, passes, engine, device, threads) -> None:
    """Makes the borrowed scene render as `capture` says, into multi-layer EXR, whatever was set before."""
    render, layer = stage.render, stage.view_layers[0]
    render.engine = engine
    render.resolution_x, render.resolution_y, render.resolution_percentage = width, height, 100
    render.pixel_aspect_x = render.pixel_aspect_y = 1
    render.use_border = render.use_motion_blur = render.use_freestyle = render.use_stamp = False
    render.use_compositing = render.use_sequencer = False
    render.film_transparent = render.use_persistent_data = True
    if threads:
        render.threads_mode, render.threads = "FIXED", threads
    if engine == "CYCLES":
        cycles = stage.cycles
        cycles.device, cycles.samples, cycles.time_limit = device, samples, 0
        cycles.use_adaptive_sampling = cycles.use_denoising = cycles.use_animated_seed = False
        cycles.sample_offset = 0
        if hasattr(cycles, "use_sample_subset"):  # Blender 5
            cycles.use_sample_subset = False
        cycles.film_exposure, cycles.film_transparent_glass = 1, False
        cycles.pixel_filter_type, cycles.filter_width = "BLACKMAN_HARRIS", 1.5
    else:
        stage.eevee.taa_render_samples = samples
    for name in [x for x in dir(layer) if x.startswith("use_pass_")]:
        setattr(layer, name, False)
    layer.use_pass_combined = True
    layer.use_pass_z = layer.use_pass_vector = passes
    layer.use, layer.samples = True, 0
    image = render.image_settings
    if hasattr(image, "media_type"):  # Blender 5: this comes before the format
        image.media_type = "MULTI_LAYER_IMAGE"
    image.file_format, image.color_depth, image.exr_codec = "OPEN_EXR_MULTILAYER", "32", "NONE"
    image.views_format = "INDIVIDUAL"
    render.use_file_extension = render.use_overwrite = True
    render.views_format = "MULTIVIEW"


def even_light(stage, made: list) -> None:
    """Three suns and a grey world: the same for every object, wherever it lies and however large it is."""
    world = bpy.data.worlds.new("timesplat")
    made.append(world)
    if bpy.app.version < (5, 0):  # from then on it always has nodes
        world.use_nodes = True
    background = next(n for n in world.node_tree.nodes if n.type == "BACKGROUND")
    background.inputs["Color"].default_value = (1, 1, 1, 1)
    background.inputs["Strength"].default_value = WORLD
    stage.world = world
    for direction, strength in SUNS:
        sun = bpy.data.lights.new("timesplat", "SUN")
        sun.energy, sun.angle = strength, math.radians(10)
        ob = bpy.data.objects.new("timesplat", sun)
        made += [ob, sun]
        ob.rotation_euler = Vector(direction).to_track_quat("Z", "Y").to_euler()
        stage.collection.objects.link(ob)


class _Cameras:
    """The cameras of one frame, as views of one render. They are placed, never keyed: no camera motion gets
    into the motion vectors."""

    def __init__(self, stage, made: list, normalisation: Normalisation) -> None:
        self.stage, self.made, self.normalisation = stage, made, normalisation
        self.objects: list = []
        self.stem = "timesplat"
        while any(ob.name.startswith(self.stem) for ob in bpy.data.objects if ob.type == "CAMERA"):
            self.stem += "-"  # views find their cameras by name

    def place(self, shots: list[Shot]) -> None:
        while len(self.objects) < len(shots):
            name = f"{self.stem}_v{len(self.objects)}"
            data = bpy.data.cameras.new(name)
            data.sensor_fit = "AUTO"  # the longer side
            data.clip_start, data.clip_end = 1e-3 * self.normalisation.scale, 1e3 * self.normalisation.scale
            ob = bpy.data.objects.new(name, data)
            self.made += [ob, data]
            self.stage.collection.objects.link(ob)
            self.objects.append(ob)
        for ob, shot in zip(self.objects, shots, strict=False):
            ob.matrix_world = Matrix(self.normalisation.to_world(shot.c2w).tolist())
            ob.data.angle = math.radians(shot.fov)
            ob.data.shift_x, ob.data.shift_y = shot.shift
        self.stage.camera = self.objects[0]
        self.count = len(shots)
        render = self.stage.render
        render.use_multiview = self.count > 1
        views = render.views
        while len(views) > max(self.count, 1):
            views.remove(views[len(views) - 1])
        while len(views) < self.count:
            views.new(f"v{len(views)}")
        for i, view in enumerate(views):
            view.name, view.camera_suffix, view.file_suffix, view.use = f"v{i}", f"_v{i}", f"_v{i}", True

    def render(self, folder: Path) -> list[Path]:
        """Renders and returns one EXR for each camera placed; they are overwritten by the next call."""
        self.stage.render.filepath = str(folder / "frame")
        with bpy.context.temp_override(scene=self.stage):  # the operator's own `scene` keeps the old frame
            bpy.ops.render.render(write_still=True)
        if self.count == 1:
            return [folder / "frame.exr"]
        return [folder / f"frame_v{i}.exr" for i in range(self.count)]
