# SPDX-License-Identifier: GPL-3.0-or-later
"""What there is for an asset object: its sliders and buttons, in the sidebar and in its properties, and a menu."""

from __future__ import annotations

import bpy

from ..asset.sliders import SLIDERS, asset_modifier, get_input, input_property, is_asset
from ..asset.visibility import shown
from ..operators.view_colours import shows_colours


class _Result:
    bl_label = "Result"
    bl_region_type = "WINDOW"

    @classmethod
    def poll(cls, context):
        return is_asset(context.object)

    def draw(self, context):
        """Only what is at hand: nothing is evaluated, read or counted here. What is needed first is at the top."""
        layout, ob = self.layout, context.object
        modifier = asset_modifier(ob)
        row, now = layout.row(align=True), shown(ob, context)
        for what in ("Original", "Both", "Result"):  # operator_enum would put them below one another
            row.operator("timesplat.show", text=what, depress=what.upper() == now).what = what.upper()
        _draw_colours(layout, context)
        layout.use_property_split = True
        count = len(ob.data.points if ob.type == "POINTCLOUD" else ob.data.vertices)
        layout.label(text=f"{count:,} Gaussians", icon="POINTCLOUD_DATA")
        _draw_sliders(layout.column(align=True), modifier, "")
        row = layout.row(align=True)
        row.operator("timesplat.compare", icon="IMAGE_DATA")
        row.operator("timesplat.export_video", icon="RENDER_ANIMATION")
        row.operator("timesplat.export_asset", text="Export", icon="EXPORT")
        for title in ("Time", "Crop"):
            header, body = layout.panel(f"timesplat_{title.lower()}", default_closed=True)
            header.label(text=title)
            if body:
                _draw_sliders(body.column(align=True), modifier, title)
        header, body = layout.panel("timesplat_edit", default_closed=True)
        header.label(text="Edit")
        if body:
            column = body.column(align=True)
            column.operator("timesplat.bake", icon="ACTION")
            column.operator("timesplat.delete_rectangle", icon="SELECT_SET")
            column.operator_menu_enum("timesplat.delete", "what", text="Delete", icon="TRASH")


def _draw_colours(layout, context) -> None:
    """The button that shows colours where the 3D view does not, and the one that shows them as they are where its view
    transform, or that of renders, changes them."""
    space, transform = context.space_data, context.scene.view_settings.view_transform
    in_view = space and space.type == "VIEW_3D"
    if in_view and not shows_colours(space.shading, context.object):
        row = layout.row()
        row.scale_y = 1.5
        row.operator("timesplat.show_colours", icon="SHADING_RENDERED")
    elif transform != "Standard" and not (in_view and space.shading.type == "SOLID"):
        column = layout.column(align=True)
        column.label(text=f"{transform} changes the colours", icon="ERROR")
        column.operator("timesplat.set_standard")


def _draw_sliders(column, modifier, panel: str) -> None:
    for name, slider in SLIDERS.items():
        found = input_property(modifier, name) if slider.panel == panel else None
        if found and (name not in ("Crop Min", "Crop Max") or get_input(modifier, "Crop")):
            column.prop(*found, text=name)


class TIMESPLAT_PT_result(_Result, bpy.types.Panel):
    bl_space_type, bl_region_type = "VIEW_3D", "UI"
    bl_category = "Timesplat"
    bl_order = 0  # above all else of the tab: it is there only while an asset is active


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
        layout.operator("timesplat.export_video")
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
