# SPDX-License-Identifier: GPL-3.0-or-later
"""What there is for an asset object: its sliders and buttons, in the sidebar and in its properties, and a menu."""

from __future__ import annotations

import bpy

from ..asset.sliders import SLIDERS, asset_modifier, get_input, input_property, is_asset


class _Result:
    bl_label = "Result"
    bl_region_type = "WINDOW"

    @classmethod
    def poll(cls, context):
        return is_asset(context.object)

    def draw(self, context):
        """Only what is at hand: nothing is evaluated, read or counted here."""
        layout, ob = self.layout, context.object
        modifier = asset_modifier(ob)
        layout.use_property_split = True
        count = len(ob.data.points if ob.type == "POINTCLOUD" else ob.data.vertices)
        layout.label(text=f"{count:,} Gaussians", icon="POINTCLOUD_DATA")
        row = layout.row(align=True)
        for what in ("Original", "Both", "Result"):  # operator_enum would put them below one another
            row.operator("timesplat.show", text=what).what = what.upper()
        panel, column = "", layout.column(align=True)
        for name, slider in SLIDERS.items():
            found = input_property(modifier, name)
            if found is None or (name in ("Crop Min", "Crop Max") and not get_input(modifier, "Crop")):
                continue
            if slider.panel != panel:
                panel, column = slider.panel, layout.column(align=True)
            column.prop(*found, text=name)
        space = context.space_data
        if space and space.type == "VIEW_3D" and space.shading.type in ("SOLID", "WIREFRAME"):
            layout.operator("timesplat.show_colours", icon="SHADING_RENDERED")
        if (transform := context.scene.view_settings.view_transform) != "Standard":
            column = layout.column(align=True)
            column.label(text=f"{transform} changes the colours", icon="ERROR")
            column.operator("timesplat.set_standard")
        column = layout.column(align=True)
        column.operator("timesplat.compare", icon="IMAGE_DATA")
        column.operator("timesplat.bake", icon="ACTION")
        column.operator("timesplat.delete_rectangle", icon="SELECT_SET")
        column.operator_menu_enum("timesplat.delete", "what", text="Delete", icon="TRASH")
        column.operator("timesplat.export_asset", text="Export", icon="EXPORT")


class TIMESPLAT_PT_result(_Result, bpy.types.Panel):
    bl_space_type, bl_region_type = "VIEW_3D", "UI"
    bl_category = "Timesplat"
    bl_order = 10


class TIMESPLAT_PT_result_properties(_Result, bpy.types.Panel):
    bl_label = "Timesplat"
    bl_space_type = "PROPERTIES"
    bl_context = "data"


class TIMESPLAT_MT_result(bpy.types.Menu):
    """What makes the operators reachable from the menu search"""

    bl_label = "Timesplat"

    def draw(self, context):
        layout = self.layout
        layout.operator_enum("timesplat.show", "what")
        layout.operator("timesplat.compare")
        layout.operator("timesplat.bake")
        layout.separator()
        layout.operator("timesplat.delete_rectangle")
        layout.operator_enum("timesplat.delete", "what")


def _menu(self, context):
    if is_asset(context.object):
        self.layout.menu("TIMESPLAT_MT_result")


CLASSES = (TIMESPLAT_PT_result, TIMESPLAT_PT_result_properties, TIMESPLAT_MT_result)
register_classes, unregister_classes = bpy.utils.register_classes_factory(CLASSES)


def register() -> None:
    register_classes()
    bpy.types.VIEW3D_MT_object.append(_menu)


def unregister() -> None:
    bpy.types.VIEW3D_MT_object.remove(_menu)
    unregister_classes()
