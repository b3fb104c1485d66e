# SPDX-License-Identifier: GPL-3.0-or-later
"""Original and reconstruction: which of them the scene shows (`timesplat.show`), and both with their difference side by
side at the present frame (`timesplat.compare`).

For the latter both are rendered by Cycles, small, in a Blender of their own (`beside`), as the capture rendered what
the asset was made from: with Even Light where that was on, over white, colours as they are. The picture is the image
"Timesplat Compare".
"""

from __future__ import annotations

import math
from pathlib import Path

import bpy
import numpy as np
from bpy.props import EnumProperty, IntProperty
from mathutils import Matrix

from ...datagen import capture
from ...datagen.scene import borrowed, shown_objects
from ...datagen.sequence import InputError
from ..asset import display
from ..runtime import background_blender, jobs
from . import edit

IMAGE = "Timesplat Compare"
SPLAT_SAMPLES = 2  # splats are smooth and glow by themselves: more samples change next to nothing
GAIN = 4  # the difference is shown this many times as strong


def originals_of(ob, context) -> list:
    """The objects that the asset was made from: those that `timesplat_source` names, else all that renders show but
    assets. Raises InputError where there is none in the scene."""
    scene, names = context.scene, ob.get("timesplat_source")
    found = [scene.objects[name] for name in names or () if name in scene.objects]
    if names is None:
        found = shown_objects(scene, context.view_layer)
    found = [o for o in found if o.type not in ("CAMERA", "LIGHT") and not o.get("timesplat")]
    if not found:
        raise InputError(f"{ob.name}: what it was made from is not in this scene; open the scene that has it.")
    return found


def start(ob, context, size: int, samples: int) -> jobs.Job:
    """Starts the comparison as a Job; its end shows the picture. The view is the scene's camera's, or without one the
    3D view's; `size` pixels is its longer side, `samples` are the original's. Raises InputError where there is no view
    or nothing to compare with."""
    scene = context.scene
    if not hasattr(scene, "cycles"):
        raise InputError("Cycles, which renders the comparison, is switched off; enable it in the preferences.")
    request = {
        "asset": ob.name,
        "originals": [o.name for o in originals_of(ob, context)],
        "lights": [o.name for o in shown_objects(scene, context.view_layer) if o.type == "LIGHT"],
        "even": bool(ob.get("timesplat_lighting", True)),
        "view": None if scene.camera and scene.camera.type == "CAMERA" else _view(context),
        "size": size,
        "samples": samples,
    }

    def finish(event: dict, folder: Path) -> str:
        show(to_image(np.load(folder / "compared.npy")), bpy.context)
        return f"Original, reconstruction, {GAIN} times the difference: {event['psnr']:.1f} dB PSNR."

    return jobs.start(
        "Compare", [lambda folder: background_blender.start("addon.operators.compare", request, folder)], finish
    )


def _view(context) -> dict:
    """The 3D view as a camera: settings of its data, matrix in the world, width and height."""
    for area in context.screen.areas if context.screen and not bpy.app.background else ():
        if area.type != "VIEW_3D":
            continue
        space, region = area.spaces.active, next(r for r in area.regions if r.type == "WINDOW")
        data = {"sensor_width": 72, "lens": space.lens}  # the 3D view's sensor
        data |= {"clip_start": space.clip_start, "clip_end": space.clip_end}
        if space.region_3d.view_perspective == "ORTHO":
            data |= {"type": "ORTHO", "ortho_scale": space.region_3d.view_distance * 72 / space.lens}
        matrix = [list(row) for row in space.region_3d.view_matrix.inverted()]
        return {"data": data, "matrix": matrix, "width": region.width, "height": region.height}
    raise InputError(f"{context.scene.name}: there is no camera and no 3D view to look through; add a camera.")


# ---------------------------------------------------------------- in the Blender beside


def compare(request: dict, progress) -> dict:
    """Writes compared.npy, (height, 3 · width, 3) float32, sRGB-encoded, rows from the top: what the asset was made
    from, the asset, GAIN times their absolute difference; returns the PSNR in dB over the whole picture."""
    scene = bpy.context.scene
    named = {key: [scene.objects[n] for n in request[key]] for key in ("originals", "lights")}
    view = _camera(scene, request["view"])
    progress(0.1, "rendering the original")
    truth = _picture(scene, [*named["originals"], *named["lights"]], view, request, request["samples"])
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
        if modifier := display.sampler(ob):
            display.set_input(modifier, "Look", "Splats")
    with borrowed(objects, lights=not request["even"]) as stage, capture.temporary() as made:
        capture.render_settings(stage, width, height, samples, False, "CYCLES", "CPU", 0)
        if request["even"]:
            capture.even_light(stage, made)
        stage.render.use_multiview = False
        stage.cycles.transparent_max_bounces = display.TRANSPARENT_BOUNCES
        stage.cycles.min_transparent_bounces = display.TRANSPARENT_BOUNCES  # no roulette: less noise
        camera = bpy.data.objects.new("timesplat", data)
        made.append(camera)
        camera.matrix_world = matrix
        stage.collection.objects.link(camera)
        stage.camera = camera
        stage.frame_set(scene.frame_current, subframe=scene.frame_subframe)
        stage.render.filepath = str(Path.cwd() / "frame")
        with bpy.context.temp_override(scene=stage):
            bpy.ops.render.render(write_still=True)
    rgba = capture.straight_srgb(capture.read_multilayer(Path("frame.exr"))["combined"]) / np.float32(255)
    return rgba[..., :3] * rgba[..., 3:] + (1 - rgba[..., 3:])


# ---------------------------------------------------------------- in the artist's Blender


def to_image(pixels: np.ndarray):
    """The image datablock IMAGE with (H,W,3) sRGB-encoded values, rows from the top."""
    height, width, _ = pixels.shape
    image = bpy.data.images.get(IMAGE)
    if image and tuple(image.size) != (width, height):
        bpy.data.images.remove(image)
        image = None
    image = image or bpy.data.images.new(IMAGE, width, height)
    rgba = np.concatenate([pixels, np.ones_like(pixels[..., :1])], 2)[::-1]
    image.pixels.foreach_set(np.ascontiguousarray(rgba, np.float32).ravel())
    image.update()
    image.pack()
    return image


def show(image, context) -> None:
    """Shows the image in an image editor: one that is open, else in a window of its own."""
    if bpy.app.background or not context.window:
        return
    windows = context.window_manager.windows
    areas = [a for w in windows for a in w.screen.areas if a.type == "IMAGE_EDITOR"]
    if not areas:
        bpy.ops.wm.window_new()
        areas = [windows[-1].screen.areas[0]]
        areas[0].type = "IMAGE_EDITOR"
    areas[0].spaces.active.image = image
    areas[0].tag_redraw()


class TIMESPLAT_OT_show(bpy.types.Operator):
    """Show the original, the reconstruction or both, in 3D views and in renders"""

    bl_idname = "timesplat.show"
    bl_label = "Show"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    what: EnumProperty(
        name="Show",
        items=[
            ("ORIGINAL", "Original", "What the reconstruction was made from, alone"),
            ("BOTH", "Both", "The original and the reconstruction, one over the other"),
            ("RESULT", "Result", "The reconstruction alone"),
        ],
        default="RESULT",
    )

    poll = edit.TIMESPLAT_OT_delete.poll

    def execute(self, context):
        try:
            originals = originals_of(context.object, context)
        except InputError as e:
            self.report({"ERROR"}, str(e))
            return {"CANCELLED"}
        hidden = dict.fromkeys(originals, self.what == "RESULT") | {context.object: self.what == "ORIGINAL"}
        for ob, hide in hidden.items():
            if ob.name in context.view_layer.objects:
                ob.hide_set(hide)
            if ob.is_editable:  # what is linked from another file is not
                ob.hide_render = hide
        return {"FINISHED"}


class TIMESPLAT_OT_compare(bpy.types.Operator):
    """Render the original, the reconstruction and their difference at this frame, side by side"""

    bl_idname = "timesplat.compare"
    bl_label = "Compare"

    size: IntProperty(name="Size", description="Pixels of the longer side of each picture", default=384, min=16)
    samples: IntProperty(name="Samples", description="Cycles samples a pixel of the original", default=16, min=1)

    poll = edit.TIMESPLAT_OT_delete.poll

    def invoke(self, context, event):
        try:
            start(context.object, context, self.size, self.samples)
        except InputError as e:
            self.report({"ERROR"}, str(e))
            return {"CANCELLED"}
        return {"FINISHED"}

    def execute(self, context):
        try:
            job = start(context.object, context, self.size, self.samples)
            jobs.wait(job)
        except InputError as e:
            self.report({"ERROR"}, str(e))
            return {"CANCELLED"}
        self.report({"INFO"}, job.message)
        return {"FINISHED"}


CLASSES = (TIMESPLAT_OT_show, TIMESPLAT_OT_compare)


def register() -> None:
    for cls in CLASSES:
        bpy.utils.register_class(cls)


def unregister() -> None:
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)


if __name__ == "__main__":
    background_blender.serve(compare)
