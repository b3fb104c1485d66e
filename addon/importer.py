# SPDX-License-Identifier: GPL-3.0-or-later
"""File > Import > 4D Gaussians (.ply), also by dropping a file on the viewport and headless:
`bpy.ops.timesplat.import_ply(filepath=…)`."""

from pathlib import Path

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, StringProperty

from ..datagen.sequence import InputError
from ..model.asset import VISIBLE, read_ply
from . import display

LOOK_ITEMS = [
    ("Automatic", "Automatic", "Points in the viewport, Splats in renders"),
    ("Points", "Points", "Opaque dots: fast"),
    ("Splats", "Splats", "Soft ellipsoids, as the asset was fitted: slower"),
]


class TIMESPLAT_OT_import_ply(bpy.types.Operator):
    """Import a 3D or 4D Gaussian splat file as a point cloud that plays with the timeline"""

    bl_idname = "timesplat.import_ply"
    bl_label = "Import 4D Gaussians"
    bl_options = {"REGISTER", "UNDO", "PRESET"}  # noqa: RUF012

    filepath: StringProperty(subtype="FILE_PATH", options={"SKIP_SAVE"})
    filter_glob: StringProperty(default="*.ply", options={"HIDDEN"})
    look: EnumProperty(name="Look", items=LOOK_ITEMS, default="Automatic")
    opacity_cut: FloatProperty(
        name="Opacity Cut",
        description="Gaussians fainter than this at a moment are left out",
        default=VISIBLE,
        min=0,
        max=1,
    )
    use_clip: BoolProperty(
        name="Set Frame Range",
        description="Give the scene the frame range and the frame rate of the clip",
        default=False,
    )

    @classmethod
    def poll(cls, context):
        return context.mode == "OBJECT"

    def invoke(self, context, event):
        if self.filepath:  # dropped on the viewport
            return context.window_manager.invoke_props_dialog(self)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context):
        path = Path(bpy.path.abspath(self.filepath))
        try:
            asset = read_ply(path)
        except InputError as e:
            self.report({"ERROR"}, str(e))
            return {"CANCELLED"}
        display.add_asset(asset, path.stem, look=self.look, cut=self.opacity_cut, context=context)
        if self.use_clip:
            display.play_clip(context.scene, asset.clip)
        self.report({"INFO"}, f"{len(asset)} Gaussians from {path.name}; their sRGB colours are linear now.")
        return {"FINISHED"}


class TIMESPLAT_FH_ply(bpy.types.FileHandler):
    bl_idname = "TIMESPLAT_FH_ply"
    bl_label = "4D Gaussians"
    bl_import_operator = "timesplat.import_ply"
    bl_file_extensions = ".ply"

    @classmethod
    def poll_drop(cls, context):
        return context.area and context.area.type == "VIEW_3D"


def _menu(self, context):
    self.layout.operator(TIMESPLAT_OT_import_ply.bl_idname, text="4D Gaussians (.ply)")


CLASSES = (TIMESPLAT_OT_import_ply, TIMESPLAT_FH_ply)


def register() -> None:
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.TOPBAR_MT_file_import.append(_menu)


def unregister() -> None:
    bpy.types.TOPBAR_MT_file_import.remove(_menu)
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
