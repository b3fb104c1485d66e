# SPDX-License-Identifier: GPL-3.0-or-later
"""Bakes the sliders: a new asset of a range of frames in place of the object."""

from __future__ import annotations

import bpy
from bpy.props import IntProperty

from ..asset.edit import bake
from .common import OnAsset, errors_reported


class TIMESPLAT_OT_bake(OnAsset, bpy.types.Operator):
    """Make a new asset of a range of frames with the sliders applied; the original is hidden"""

    bl_idname = "timesplat.bake"
    bl_label = "Bake"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    frame_start: IntProperty(name="Start", description="First frame; by default the scene's", options={"SKIP_SAVE"})
    frame_end: IntProperty(name="End", description="Last frame; by default the scene's", options={"SKIP_SAVE"})

    def invoke(self, context, event):
        self.frame_start, self.frame_end = self._frames(context)
        return context.window_manager.invoke_props_dialog(self)

    def _frames(self, context) -> tuple[int, int]:
        given, scene = self.properties.is_property_set, context.scene
        return (
            self.frame_start if given("frame_start") else scene.frame_start,
            self.frame_end if given("frame_end") else scene.frame_end,
        )

    def execute(self, context):
        ob, frames = context.object, self._frames(context)
        if frames[1] < frames[0]:
            self.report({"ERROR"}, f"The range {frames[0]} to {frames[1]} is empty; set End after Start.")
            return {"CANCELLED"}
        with errors_reported(self):
            new = bake(ob, frames, context)
            clip = new["timesplat_clip"]
            count = len(new.data.attributes["gs_t"].data)
            self.report({"INFO"}, f"{count} Gaussians, frames {clip['frame_start']} to {clip['frame_end']}.")
            return {"FINISHED"}
        return {"CANCELLED"}


register, unregister = bpy.utils.register_classes_factory((TIMESPLAT_OT_bake,))
