# SPDX-License-Identifier: GPL-3.0-or-later
"""File > Export > 4D Gaussians Film: a turntable of the active asset, playing while it turns, or what the scene's
camera sees of it over the scene's frames. A Job: the worker's rasteriser draws it.

    bpy.ops.timesplat.export_video(filepath="fox.mp4")                             or .webp, or a folder for .png
    bpy.ops.timesplat.export_video(filepath="fox.webp", camera="SCENE", size=1280, transparent=True)

What the sliders do is in the film. The asset stands where it is now; in films by the scene's camera it alone is seen.
"""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path

import bpy
import numpy as np
from bpy.props import BoolProperty, EnumProperty, IntProperty, StringProperty

from ...datagen.sequence import InputError
from ...model.io.ply import write_ply
from ..asset.apply_sliders import with_sliders
from ..asset.timeline import visit_frames
from ..runtime import child_process, jobs, worker_options
from ..runtime.capture import rigid_pose
from .common import OnAsset, errors_reported
from .export_asset import with_place

SUFFIXES = {"MP4": ".mp4", "WEBP": ".webp", "PNG": ""}
KIND_ITEMS = [
    ("MP4", "Video (.mp4)", "H.264, for every player"),
    ("WEBP", "Animated WebP", "Loops in browsers and chats; may be transparent"),
    ("PNG", "Pictures (.png)", "A new folder with a picture a frame; may be transparent"),
]
CAMERA_ITEMS = [
    ("TURNTABLE", "Turntable", "Once around it, while its clip plays"),
    ("SCENE", "Scene Camera", "What the scene's camera sees at every frame of the scene"),
]


def seen_by(scene, context) -> list[dict]:
    """What the scene's camera is at each frame of the scene, as `model.film_command.read_cameras` has it. Raises
    InputError."""
    found, render = [], scene.render
    wide, high = render.resolution_x * render.pixel_aspect_x, render.resolution_y * render.pixel_aspect_y
    for frame in visit_frames(range(scene.frame_start, scene.frame_end + 1), context):
        camera = scene.camera
        if camera is None or camera.type != "CAMERA" or camera.data.type != "PERSP":
            raise InputError(f"{scene.name}: at frame {frame} it has no perspective camera; choose one, or Turntable.")
        lens = camera.calc_matrix_camera(
            context.evaluated_depsgraph_get(),
            x=render.resolution_x,
            y=render.resolution_y,
            scale_x=render.pixel_aspect_x,
            scale_y=render.pixel_aspect_y,
        )
        longer = max(wide, high)
        angle = 2 * math.atan(1 / (lens[0][0] if wide >= high else lens[1][1]))
        shift = lens[0][2] * wide / 2 / longer, lens[1][2] * high / 2 / longer
        matrix = rigid_pose(camera).tolist()
        found.append({"frame": frame, "transform_matrix": matrix, "camera_angle_x": angle, "shift": shift})
    return found


class TIMESPLAT_OT_export_video(OnAsset, bpy.types.Operator):
    """Film the active asset: a turntable that plays while it turns, or what the scene's camera sees of it"""

    bl_idname = "timesplat.export_video"
    bl_label = "Film"
    bl_options = {"PRESET"}  # noqa: RUF012

    filepath: StringProperty(name="File", subtype="FILE_PATH", options={"SKIP_SAVE"})
    check_existing: BoolProperty(default=True, options={"HIDDEN", "SKIP_SAVE"})
    filter_glob: StringProperty(default="*.mp4;*.webp", options={"HIDDEN"})
    kind: EnumProperty(name="Format", items=KIND_ITEMS, default="MP4")
    camera: EnumProperty(name="Camera", items=CAMERA_ITEMS, default="TURNTABLE")
    size: IntProperty(name="Size", description="Pixels of the longer side", default=512, min=16, max=8192)
    plays: IntProperty(
        name="Plays",
        description="How often the clip plays in one turn; 0: as often as takes four seconds",
        default=0,
        min=0,
    )
    transparent: BoolProperty(name="Transparent", description="In place of white", default=False)
    interactive = False

    def invoke(self, context, event):
        self.interactive = True
        if not self.filepath:
            folder = Path(bpy.data.filepath).parent if bpy.data.filepath else Path()
            self.filepath = str(folder / bpy.path.clean_name(context.object.name))
        self.check(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def check(self, context):
        path = str(self.path())
        changed, self.filepath = path != self.filepath, path
        return changed

    def path(self) -> Path:
        """With the format's suffix, in place of another format's."""
        path = Path(self.filepath)
        base = path.with_suffix("") if path.suffix.lower() in (".mp4", ".webp") else path
        return base.with_name(base.name + SUFFIXES[self.kind])

    def draw(self, context):
        layout = self.layout
        layout.use_property_split, layout.use_property_decorate = True, False
        for name in ("kind", "camera", "size"):
            layout.prop(self, name)
        if self.camera == "TURNTABLE":
            layout.prop(self, "plays")
        if self.kind != "MP4":
            layout.prop(self, "transparent")

    def execute(self, context):
        if not self.properties.is_property_set("kind"):
            suffix = Path(self.filepath).suffix.lower()
            self.kind = next((k for k, s in SUFFIXES.items() if s == suffix), "MP4")
        with errors_reported(self):
            if not self.filepath:
                raise InputError("No file was named; choose one.")
            job = self.start(Path(bpy.path.abspath(str(self.path()))), context)
            if self.interactive:
                self.report({"INFO"}, "Filming; Esc over a 3D view cancels.")
                return {"FINISHED"}
            jobs.wait(job)
            self.report({"INFO"}, job.message)
            return {"FINISHED"}
        return {"CANCELLED"}

    def start(self, path: Path, context) -> jobs.Job:
        """Starts the Job. Raises InputError before anything has been done."""
        ob, scene = context.object, context.scene
        python = worker_options.worker_python(context)
        if not path.parent.is_dir():
            raise InputError(f"{path}: there is no such folder; choose another.")
        if not path.suffix and path.exists() and (not path.is_dir() or any(path.iterdir())):
            raise InputError(f"{path}: it exists already and is not an empty folder; choose another name.")
        context.view_layer.update()  # a script may have moved it just now
        asset = with_place(with_sliders(ob), np.array(ob.matrix_world))
        cameras, width, height = None, self.size, self.size
        request: dict = {"task": "video", "plays": self.plays}
        if self.camera == "SCENE":
            cameras = seen_by(scene, context)
            wide = scene.render.resolution_x * scene.render.pixel_aspect_x
            high = scene.render.resolution_y * scene.render.pixel_aspect_y
            width, height = (max(round(x * self.size / max(wide, high)), 1) for x in (wide, high))
            request["fps"] = scene.render.fps / scene.render.fps_base
        request["size"] = [width, height]
        request["background"] = "none" if self.transparent and self.kind != "MP4" else "ffffff"

        def draw(folder: Path) -> child_process.Child:
            write_ply(folder / "asset.ply", asset)
            places = {"asset": str(folder / "asset.ply"), "out": str(folder / "film" / path.name)}
            if cameras:
                (folder / "cameras.json").write_text(json.dumps({"frames": cameras}))
                places["cameras"] = str(folder / "cameras.json")
            return child_process.start_worker(python, request | places, folder)

        def finish(event: dict, folder: Path) -> str:
            try:
                if path.is_dir():
                    path.rmdir()
                shutil.move(folder / "film" / path.name, path)
            except OSError as e:
                raise InputError(f"{path}: it cannot be written ({e.strerror or e}); choose another place.") from None
            return f"{path.name}: {event['pictures']} pictures"

        return jobs.start("Film", [draw], finish)


def _menu(self, context):
    self.layout.operator("timesplat.export_video", text="4D Gaussians Film (.mp4, .webp, .png)")


def register() -> None:
    bpy.utils.register_class(TIMESPLAT_OT_export_video)
    bpy.types.TOPBAR_MT_file_export.append(_menu)


def unregister() -> None:
    bpy.types.TOPBAR_MT_file_export.remove(_menu)
    bpy.utils.unregister_class(TIMESPLAT_OT_export_video)
