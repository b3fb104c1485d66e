# SPDX-License-Identifier: GPL-3.0-or-later
"""Original and reconstruction: which of them the scene shows (`timesplat.show`), and both with their difference side by
side at the present frame (`timesplat.compare`).

For the latter both are rendered in the background (`render_comparison`). The picture is the image "Timesplat Compare".
"""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
from bpy.props import EnumProperty, IntProperty

from ...datagen.scene.borrow import shown_objects
from ...datagen.sequence import InputError
from ..asset.sliders import asset_modifier, get_input
from ..asset.visibility import show
from ..runtime import background_blender, child_process, jobs
from ..runtime.render_comparison import GAIN
from .common import OnAsset, errors_reported

IMAGE = "Timesplat Compare"
OTHER_FRAMES = 4
VERDICTS = (  # dB inside the object, from which on it looks like this
    (34, "Hard to tell apart"),
    (29, "Close; fine detail is softer"),
    (24, "The same thing, visibly softer"),
    (-1e9, "Far off"),
)


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
        "view": None if scene.camera and scene.camera.type == "CAMERA" else _viewport_camera(context),
        "size": size,
        "samples": samples,
        "frames": _other_frames(ob, scene.frame_current),
    }

    def finish(event: dict, folder: Path) -> str:
        show_image(to_image(np.load(folder / "compared.npy")), bpy.context)
        return in_words(event)

    def render(folder: Path) -> child_process.Child:
        return background_blender.start("addon.runtime.render_comparison", request, folder)

    return jobs.start("Compare", [render], finish)


def _other_frames(ob, now: int) -> list[int]:
    """OTHER_FRAMES frames of the clip, evenly over it, to look for the worst."""
    modifier = asset_modifier(ob)
    start, end = (get_input(modifier, f"Frame {x}") for x in ("Start", "End"))
    found = {round(start + (end - start) * (i + 0.5) / OTHER_FRAMES) for i in range(OTHER_FRAMES)}
    return sorted(found - {now})


def in_words(event: dict) -> str:
    """What a comparison came to, in a sentence."""
    whole = f"The whole picture: {event['psnr']:.1f} dB PSNR"
    if event["inside"] is None:
        return f"{whole}; the object is not in it."
    verdict = next(words for least, words in VERDICTS if event["inside"] >= least)
    said = f"{verdict}: {event['inside']:.1f} dB inside the object. {whole}."
    if len(event["frames"]) > 1:
        frame, score = min(event["frames"].items(), key=lambda item: item[1])
        said += f" Worst of {len(event['frames'])} frames: {frame}, {score:.1f} dB inside."
    return f"{said} The picture: original, reconstruction, {GAIN} times their difference."


def _viewport_camera(context) -> dict:
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


def show_image(image, context) -> None:
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


class TIMESPLAT_OT_show(OnAsset, bpy.types.Operator):
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

    def execute(self, context):
        originals: list = []
        with errors_reported(self):
            originals = originals_of(context.object, context)
        if not originals:
            return {"CANCELLED"}
        show(context.object, originals, self.what, context)
        return {"FINISHED"}


class TIMESPLAT_OT_compare(OnAsset, bpy.types.Operator):
    """Render the original, the reconstruction and their difference at this frame, side by side"""

    bl_idname = "timesplat.compare"
    bl_label = "Compare"

    size: IntProperty(name="Size", description="Pixels of the longer side of each picture", default=384, min=16)
    samples: IntProperty(name="Samples", description="Cycles samples a pixel of the original", default=16, min=1)

    def invoke(self, context, event):
        with errors_reported(self):
            start(context.object, context, self.size, self.samples)
            return {"FINISHED"}
        return {"CANCELLED"}

    def execute(self, context):
        with errors_reported(self):
            job = start(context.object, context, self.size, self.samples)
            jobs.wait(job)
            self.report({"INFO"}, job.message)
            return {"FINISHED"}
        return {"CANCELLED"}


register, unregister = bpy.utils.register_classes_factory((TIMESPLAT_OT_show, TIMESPLAT_OT_compare))
