# SPDX-License-Identifier: GPL-3.0-or-later
"""File > Import > 4D Gaussians, also by dropping files on a 3D view, and headless:

    bpy.ops.timesplat.import_asset(filepath="a.ply")                                  or any other of READABLE
    bpy.ops.timesplat.import_asset(filepath="folder/")                                its .ply, .sog, …, one a frame
    bpy.ops.timesplat.import_asset(directory="folder", files=[{"name": "a.ply"}, …])  these, one a frame

What Blender lacks libraries for is read by the worker, USD where there is none with the pxr of Blender's own Python.
"""

from __future__ import annotations

import math
import tempfile
from pathlib import Path

import bpy
import numpy as np
from bpy.props import BoolProperty, CollectionProperty, EnumProperty, FloatProperty, IntProperty, StringProperty
from mathutils import Matrix, Quaternion

from ...datagen.sequence import InputError
from ...model.io.asset import VISIBLE, LoadedAsset
from ...model.io.files import FRAME_SUFFIXES, READABLE, frame_files, named, read_frames
from ...model.io.ply import read_ply
from ...model.io.usd_stage import USD_SUFFIXES
from ..asset import display
from ..runtime import child_process, worker_options
from .common import wait_cursor

LOOK_ITEMS = [
    ("Automatic", "Automatic", "Ellipsoids in the viewport, Splats in renders"),
    ("Ellipsoids", "Ellipsoids", "Opaque solids, each of its Gaussian's shape"),
    ("Points", "Points", "Opaque dots: fastest"),
    ("Splats", "Splats", "Soft ellipsoids, as the asset was fitted: slower"),
]
UP_ITEMS = [
    ("AUTO", "Automatic", "Z in Timesplat's own files, Y in .spz, -Y in other .ply, .splat and .sog, as 3DGS has it"),
    ("Z", "Z", "As in Blender: nothing is turned"),
    ("Y", "Y", "As in glTF and .spz"),
    ("-Y", "-Y", "As in 3D Gaussian Splatting and other photogrammetry"),
]
TURN_ABOUT_X = {"Z": 0, "Y": math.pi / 2, "-Y": -math.pi / 2}  # radians


def read_assets(paths: list[Path], *, fps: float, frame_start: int, context=None) -> LoadedAsset:
    """One asset from a file of any kind, or from several that are one frame each (see `files.read_frames`); by the
    worker what `python_for` says. Raises InputError."""
    path, several = paths[0], len(paths) > 1
    python = worker_options.python_for(path.suffix.lower(), context)
    if not python or not path.is_file() or (several and path.suffix.lower() in USD_SUFFIXES):
        return read_frames(paths, fps=fps, frame_start=frame_start)
    with tempfile.TemporaryDirectory(prefix="timesplat-", ignore_cleanup_errors=True) as folder:
        copy, moves = Path(folder) / "asset.ply", Path(folder) / "motion.npy"
        request = {"task": "import", "source": str(path.resolve()), "asset": str(copy), "motion": str(moves)}
        if several:
            request |= {"sources": [str(p.resolve()) for p in paths], "fps": fps, "frame_start": frame_start}
        try:
            told = child_process.ask_worker(python, request)
        except InputError as e:
            if not str(e).startswith("The process "):
                raise  # it named the file
            raise InputError(f"{path}: the library gave up on it; it is damaged, export it again. {e}.") from None
        return LoadedAsset(read_ply(copy), told["up"], told["note"], np.load(moves) if moves.exists() else None)


def key_motion(ob, frames: range, motion: np.ndarray) -> bool:
    """Keys the object's transform so that it is at each frame where `motion` (F,4,4) takes it from where it is
    now. False where that cannot be keyed, because it shears."""
    places = [Matrix(m @ np.array(ob.matrix_world)) for m in motion]
    parts = [m.decompose() for m in places]
    size = max(abs(x) for m in places for row in m for x in row)
    for m, part in zip(places, parts, strict=True):
        if not np.allclose(m, Matrix.LocRotScale(*part), atol=1e-4 * size):
            return False
    ob.rotation_mode, before = "QUATERNION", Quaternion()
    for frame, (location, turn, scale) in zip(frames, parts, strict=True):
        turn.make_compatible(before)
        ob.location, ob.rotation_quaternion, ob.scale = location, turn, scale
        before = turn
        for key in ("location", "rotation_quaternion", "scale"):
            ob.keyframe_insert(key, frame=frame)
    return True


class TIMESPLAT_OT_import_asset(bpy.types.Operator):
    """Import a 3D or 4D Gaussian splat file, or a sequence of them, as a point cloud that plays with the timeline"""

    bl_idname = "timesplat.import_asset"
    bl_label = "Import 4D Gaussians"
    bl_options = {"REGISTER", "UNDO", "PRESET"}  # noqa: RUF012

    filepath: StringProperty(
        name="File",
        description=f"A file, or a folder of {named(FRAME_SUFFIXES)}, one a frame",
        subtype="FILE_PATH",
        options={"SKIP_SAVE"},
    )
    directory: StringProperty(subtype="DIR_PATH", options={"HIDDEN", "SKIP_SAVE"})
    files: CollectionProperty(
        name="Files",
        description="Several are the frames of a sequence, in the natural order of their names",
        type=bpy.types.OperatorFileListElement,
        options={"HIDDEN", "SKIP_SAVE"},
    )
    filter_glob: StringProperty(default=";".join(f"*{s}" for s in READABLE), options={"HIDDEN"})
    look: EnumProperty(name="Look", items=LOOK_ITEMS, default="Automatic")
    opacity_cut: FloatProperty(
        name="Opacity Cut",
        description="Gaussians fainter than this at a moment are left out",
        default=VISIBLE,
        min=0,
        max=1,
    )
    up: EnumProperty(name="Up Axis", description="What points up in the file", items=UP_ITEMS, default="AUTO")
    use_clip: BoolProperty(
        name="Set Frame Range",
        description="Give the scene the frame range and the frame rate of the clip",
        default=False,
    )
    frame_start: IntProperty(name="Start Frame", description="Frame of a sequence's first file", default=1)
    fps: FloatProperty(
        name="Frame Rate",
        description="Files a second of a sequence; it matters where Set Frame Range is on, and in exports",
        default=24,
        min=0.01,
        soft_max=240,
    )

    @classmethod
    def poll(cls, context):
        return context.mode == "OBJECT"

    def invoke(self, context, event):
        if self.filepath or self.files:  # dropped on the viewport
            return context.window_manager.invoke_props_dialog(self)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def draw(self, context):
        layout = self.layout
        layout.use_property_split, layout.use_property_decorate = True, False
        for name in ("look", "opacity_cut", "up", "use_clip"):
            layout.prop(self, name)
        if len(self.files) != 1 or (context.space_data and context.space_data.type == "FILE_BROWSER"):
            column = layout.column(heading="Sequence")
            column.prop(self, "frame_start")
            column.prop(self, "fps")

    def paths(self) -> list[Path]:
        """The files that were chosen; those of a folder if nothing in it was. Raises InputError."""
        if names := [f.name for f in self.files if f.name]:
            return [Path(bpy.path.abspath(self.directory)) / name for name in names]
        if not self.filepath:
            raise InputError("No file was chosen; choose one, or a folder with a file a frame.")
        path = Path(bpy.path.abspath(self.filepath))
        return frame_files(path) if path.is_dir() else [path]

    def execute(self, context):
        try:
            paths = self.paths()
            with wait_cursor(context):
                loaded = read_assets(paths, fps=self.fps, frame_start=self.frame_start, context=context)
        except InputError as e:
            self.report({"ERROR"}, str(e))
            return {"CANCELLED"}
        except OSError as e:  # no room for temporary files
            self.report({"ERROR"}, f"{e.filename or paths[0]}: it cannot be written ({e.strerror or e}); make room.")
            return {"CANCELLED"}
        asset, path = loaded.asset, paths[0]
        name = path.stem if len(paths) == 1 else path.parent.name
        ob = display.add_asset(asset, name, look=self.look, cut=self.opacity_cut, context=context)
        turn = TURN_ABOUT_X[loaded.up if self.up == "AUTO" else self.up]
        ob.rotation_euler.x, ob.location = turn, Matrix.Rotation(turn, 3, "X") @ ob.location
        note = loaded.note
        if loaded.motion is not None:
            context.view_layer.update()
            if not key_motion(ob, asset.clip.frames, loaded.motion):
                note = "It moves in a way that shears it, which is left out: it stands where that starts."
        if self.use_clip:
            display.play_clip(context.scene, asset.clip)
        where = path.name if len(paths) == 1 else f"{len(paths)} files in {path.parent.name}"
        said = f"{len(asset)} Gaussians from {where}; their sRGB colours are linear now. {note}"
        self.report({"INFO"}, said.strip())
        return {"FINISHED"}


class TIMESPLAT_FH_splats(bpy.types.FileHandler):
    """Several files that are dropped at once are a sequence. Where another handler takes the suffix too (Blender's
    own for .ply and .usd), Blender asks which one is meant."""

    bl_idname = "TIMESPLAT_FH_splats"
    bl_label = "4D Gaussians"
    bl_import_operator = "timesplat.import_asset"
    bl_file_extensions = ";".join(READABLE)

    @classmethod
    def poll_drop(cls, context):
        return context.area and context.area.type == "VIEW_3D"


def _menu(self, context):
    self.layout.operator("timesplat.import_asset", text=f"4D Gaussians ({named(READABLE)})")


CLASSES = (TIMESPLAT_OT_import_asset, TIMESPLAT_FH_splats)
register_classes, unregister_classes = bpy.utils.register_classes_factory(CLASSES)


def register() -> None:
    register_classes()
    bpy.types.TOPBAR_MT_file_import.append(_menu)


def unregister() -> None:
    bpy.types.TOPBAR_MT_file_import.remove(_menu)
    unregister_classes()
