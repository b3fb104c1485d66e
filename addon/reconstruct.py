# SPDX-License-Identifier: GPL-3.0-or-later
"""The panel in the 3D viewport's sidebar, and `bpy.ops.timesplat.reconstruct()`: cameras × frames of the
scene are rendered, a worker process turns them into 4D Gaussians, and these come back as a point cloud over
the original. Called from a script or in background it returns when all is done; from the panel only the
rendering keeps Blender busy, and Esc or Cancel ends the rest.
"""

import contextlib
import shutil
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import bpy
import numpy as np
from bpy.props import BoolProperty, EnumProperty, IntProperty, PointerProperty, StringProperty

from ..datagen import rigs
from ..datagen.capture import capture
from ..datagen.scene import normalisation, shown_objects
from ..datagen.sequence import InputError, Normalisation
from ..model.asset import read_ply, write_ply
from . import display, process

ROOT = __package__.rpartition(".")[0]  # what Blender knows the add-on by
CAPTURED = 0.3  # share of the progress bar that rendering takes
METHODS = [
    ("guided", "Guided", "The network, led by depth and motion that Blender renders along"),
    ("lift", "Lift", "Depth and motion straight to Gaussians, without a network: fastest"),
    ("rgb", "Pictures only", "The network from colour alone, as it would be for photographs"),
]


class Settings:
    """What the panel and the operator have in common."""

    method: EnumProperty(name="Method", items=METHODS, default="guided")
    frames: IntProperty(
        name="Frames",
        description="At most so many frames, evenly spaced over the scene's frame range",
        default=24,
        min=1,
        max=1000,
    )
    size: IntProperty(name="Size", description="Pixels a side", default=128, min=16, max=2048, step=8)
    samples: IntProperty(name="Samples", description="Cycles samples a pixel", default=16, min=1, max=4096)
    only_selected: BoolProperty(
        name="Only Selected",
        description="Reconstruct the selected objects and their children, not all that renders show",
    )
    lighting: BoolProperty(
        name="Even Light",
        description="Three suns and a grey world, which the network was trained with, in place of the scene's lights",
        default=True,
    )
    device: EnumProperty(
        name="Device",
        description="Where the network runs",
        items=[("cpu", "CPU", ""), ("cuda", "CUDA", ""), ("mps", "Metal", "")],
        default="cpu",
    )
    look: EnumProperty(name="Look", items=[(x, x, "") for x in display.LOOKS], default=display.LOOKS[0])
    output: StringProperty(name="Save As", description="Also keep the asset as this .ply", subtype="FILE_PATH")


KEYS = tuple(Settings.__annotations__)


class TIMESPLAT_PG_settings(Settings, bpy.types.PropertyGroup):
    pass


class TIMESPLAT_preferences(bpy.types.AddonPreferences):
    bl_idname = ROOT

    python: StringProperty(
        name="Python",
        description="Interpreter with torch (pip install timesplat[torch]); empty: TIMESPLAT_PYTHON, or Blender's",
        subtype="FILE_PATH",
    )

    def draw(self, context):
        self.layout.prop(self, "python")


# ---------------------------------------------------------------- the operator


class TIMESPLAT_OT_reconstruct(Settings, bpy.types.Operator):
    """Render the selected cameras (or front, left, back and right in turn) and reconstruct 4D Gaussians"""

    bl_idname = "timesplat.reconstruct"
    bl_label = "Reconstruct"
    bl_options = {"UNDO"}  # noqa: RUF012

    active = None  # the modal one that is under way

    @classmethod
    def poll(cls, context):
        return context.mode == "OBJECT" and TIMESPLAT_OT_reconstruct.active is None

    def execute(self, context):
        with contextlib.ExitStack() as stack:
            try:
                self._start(context, stack)
                while not self._step(context, timeout=0.25):
                    pass
            except InputError as e:
                self.report({"ERROR"}, str(e))
                return {"CANCELLED"}
        return {"FINISHED"}

    def invoke(self, context, event):
        self.stack = contextlib.ExitStack()
        try:
            self._start(context, self.stack)
        except InputError as e:
            self.report({"ERROR"}, str(e))
            self.stack.close()
            return {"CANCELLED"}
        except BaseException:
            self.stack.close()
            raise
        manager = context.window_manager
        timer = manager.event_timer_add(0.25, window=context.window)
        self.stack.callback(manager.event_timer_remove, timer)
        self.stack.callback(setattr, TIMESPLAT_OT_reconstruct, "active", None)
        TIMESPLAT_OT_reconstruct.active = self
        self.stop = False
        manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        if event.type == "ESC" or self.stop:
            return self._finish(context, {"CANCELLED"}, {"INFO"}, "Reconstruction cancelled.")
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        try:
            done = self._step(context)
        except InputError as e:
            return self._finish(context, {"CANCELLED"}, {"ERROR"}, str(e))
        except BaseException:
            self.stack.close()
            raise
        _redraw(context)
        return self._finish(context, {"FINISHED"}) if done else {"PASS_THROUGH"}

    def cancel(self, context):  # Blender takes modal operators away when it opens another file or quits
        self.stack.close()

    def _finish(self, context, result, level=None, message=""):
        self.stack.close()
        _redraw(context)
        if message:
            self.report(level, message)
        return result

    def _start(self, context, stack: contextlib.ExitStack) -> None:
        """Renders, and starts the worker; what has to be undone goes onto the stack."""
        preferences = context.preferences.addons.get(ROOT)
        python = process.find_python(preferences.preferences.python if preferences else "")
        manager = context.window_manager
        manager.progress_begin(0, 100)
        stack.callback(manager.progress_end)
        folder = stack.enter_context(_work_folder())
        self.fraction, self.text, self.pending = 0.0, "rendering", None
        scene = context.scene

        def rendered(done: int, total: int) -> None:
            manager.progress_update(100 * CAPTURED * done / total)

        self.frames_taken = spread(scene.frame_start, scene.frame_end, self.frames)
        passes = self.method != "rgb"
        _capture(context, self, self.frames_taken, folder / "sequence", passes, rendered)
        request = {"sequence": str(folder / "sequence"), "asset": str(folder / "asset.ply")}
        request |= {"method": self.method, "device": self.device}
        self.worker = process.Worker(python, request, folder)
        stack.callback(self.worker.kill)

    def _step(self, context, timeout: float | None = None) -> bool:
        """Takes in what the worker said; True when the asset is in the scene. Raises InputError."""
        for event in [] if self.pending else self.worker.poll(timeout):
            if event["event"] == "error":
                raise InputError(str(event.get("message")))
            if event["event"] == "progress":
                self.fraction = CAPTURED + (1 - CAPTURED) * float(event.get("fraction", 0))
                self.text = str(event.get("text", ""))
                context.window_manager.progress_update(100 * self.fraction)
            if event["event"] == "done":
                self.pending = event
        if not self.pending:
            return False
        if context.mode != "OBJECT":  # a point cloud can be made only there
            self.text = "done: leave Edit Mode to see it"
            return False
        # the Sequence counts frames from 0; in this scene the clip lies where it was taken from
        asset = read_ply(self.pending["asset"])
        first, last = self.frames_taken[0], self.frames_taken[-1]
        asset.clip = replace(asset.clip, frame_start=first, frame_end=last)
        if self.output:
            write_ply(bpy.path.abspath(self.output), asset)
        display.add_asset(asset, "Timesplat", look=self.look, context=context)
        seconds = self.pending.get("seconds", 0)
        self.report({"INFO"}, f"{len(asset)} Gaussians in {seconds:.1f} s; their sRGB colours are linear now.")
        return True


def spread(first: int, last: int, count: int) -> list[int]:
    """At most `count` frame numbers from `first` on with one whole step between them, the smallest that
    comes within a step of `last`: an even step is what motion vectors and time need."""
    step = max(1, -(-(last - first) // max(count - 1, 1)))
    return list(range(first, last + 1, step))[:count]


def _capture(context, settings, frames: list[int], folder: Path, passes: bool, progress) -> None:
    """Renders the Sequence. Assets in the scene are left out; so is everything but the selection if asked."""
    scene, selected = context.scene, list(context.selected_objects)
    objects = shown_objects(scene, context.view_layer)
    if settings.only_selected:
        family = {o.name for s in selected for o in (s, *s.children_recursive)}
        objects = [o for o in objects if o.name in family or o.type == "LIGHT"]
    objects = [o for o in objects if not o.get("timesplat")]
    norm, aabb = normalisation(frames, objects, name=scene.name)
    cameras = [o for o in selected if o.type == "CAMERA"]
    clip = range(len(frames))
    shots = camera_shots(scene, cameras, frames, norm) if cameras else rigs.alternating(clip)
    capture(
        shots,
        folder,
        frames=frames,
        normalisation=norm,
        size=settings.size,
        samples=settings.samples,
        passes=passes,
        lighting=settings.lighting,
        objects=objects,
        aabb=aabb,
        progress=progress,
    )


def camera_shots(scene, cameras: list, frames: list[int], norm: Normalisation) -> list[rigs.Shot]:
    """What the scene's own cameras see at each frame, in normalised space: perspective, square, without
    lens shift. Raises InputError for another kind of camera."""
    for ob in cameras:
        if ob.data.type != "PERSP":
            raise InputError(f"{ob.name}: the camera is not a perspective one; change its type or unselect it.")
    shots, now = [], (scene.frame_current, scene.frame_subframe)
    for i, frame in enumerate(frames):
        scene.frame_set(frame)
        for ob in cameras:
            c2w = np.array(ob.matrix_world.normalized())
            fov = float(np.degrees(ob.data.angle))
            shots.append(rigs.Shot(i, ob.name, "scene", norm.from_world(c2w), fov))
    scene.frame_set(now[0], subframe=now[1])
    return shots


@contextlib.contextmanager
def _work_folder() -> Iterator[Path]:
    """A folder for one run, gone afterwards; those that a crash left behind go after a day."""
    parent = None
    if ROOT.startswith("bl_ext."):
        parent = Path(bpy.utils.extension_path_user(ROOT, path="runs", create=True))
        for old in parent.iterdir():
            if time.time() - old.stat().st_mtime > 86400:
                shutil.rmtree(old, ignore_errors=True)
    folder = Path(tempfile.mkdtemp(prefix="timesplat-", dir=parent))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


# ---------------------------------------------------------------- the panel


class TIMESPLAT_OT_cancel(bpy.types.Operator):
    """End the reconstruction that is under way"""

    bl_idname = "timesplat.cancel"
    bl_label = "Cancel"

    @classmethod
    def poll(cls, context):
        return TIMESPLAT_OT_reconstruct.active is not None

    def execute(self, context):
        TIMESPLAT_OT_reconstruct.active.stop = True
        return {"FINISHED"}


class TIMESPLAT_PT_panel(bpy.types.Panel):
    bl_label = "Timesplat"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "Timesplat"

    def draw(self, context):
        layout, settings = self.layout, context.scene.timesplat
        layout.use_property_split = True
        if job := TIMESPLAT_OT_reconstruct.active:
            layout.progress(factor=job.fraction, text=job.text)
            layout.operator("timesplat.cancel", icon="CANCEL")
            return
        for key in KEYS:
            layout.prop(settings, key)
        count = sum(o.type == "CAMERA" for o in context.selected_objects)
        layout.label(
            text=f"{count} selected cameras" if count else "Front, left, back, right in turn", icon="CAMERA_DATA"
        )
        operator = layout.operator("timesplat.reconstruct", icon="POINTCLOUD_DATA")
        for key in KEYS:
            setattr(operator, key, getattr(settings, key))
        layout.operator("timesplat.import_ply", icon="IMPORT")


def _redraw(context) -> None:
    for window in context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()


CLASSES = (
    TIMESPLAT_PG_settings,
    TIMESPLAT_preferences,
    TIMESPLAT_OT_reconstruct,
    TIMESPLAT_OT_cancel,
    TIMESPLAT_PT_panel,
)


def register() -> None:
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.timesplat = PointerProperty(type=TIMESPLAT_PG_settings)


def unregister() -> None:
    process.kill_all()
    del bpy.types.Scene.timesplat
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
