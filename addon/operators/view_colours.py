# SPDX-License-Identifier: GPL-3.0-or-later
"""Makes a 3D view and the scene show an asset's colours as they are."""

from __future__ import annotations

import bpy


class TIMESPLAT_OT_set_standard(bpy.types.Operator):
    """Show colours as they are: the view transform Standard. Others, like AgX, change the asset's colours"""

    bl_idname = "timesplat.set_standard"
    bl_label = "Set Standard"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def execute(self, context):
        context.scene.view_settings.view_transform = "Standard"
        return {"FINISHED"}


class TIMESPLAT_OT_show_colours(bpy.types.Operator):
    """Switch this 3D view to Material Preview, which has colours; Solid shows point clouds in grey"""

    bl_idname = "timesplat.show_colours"
    bl_label = "Show Colours"

    @classmethod
    def poll(cls, context):
        return context.area is not None and context.area.type == "VIEW_3D"

    def execute(self, context):
        context.space_data.shading.type = "MATERIAL"
        return {"FINISHED"}


register, unregister = bpy.utils.register_classes_factory((TIMESPLAT_OT_set_standard, TIMESPLAT_OT_show_colours))
