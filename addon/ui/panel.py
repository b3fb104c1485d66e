# SPDX-License-Identifier: GPL-3.0-or-later
"""The Timesplat tab in the 3D view's sidebar: what to capture, with which cameras, how to reconstruct it, what is
under way. Drawing reads settings and nothing else: no file, no evaluated object."""

import textwrap
import time

import bpy
from bl_ui.utils import PresetPanel

from ...datagen.sequence import InputError
from .. import estimates, notices, settings
from ..operators import add_cameras, presets
from ..runtime import worker_options
from ..runtime.folders import ADDON
from . import job_rows

FRESH_SECONDS = 2.0


class TIMESPLAT_PT_presets(PresetPanel, bpy.types.Panel):
    bl_label = "Timesplat Presets"
    preset_subdir = "timesplat"
    preset_operator = "script.execute_preset"
    preset_add_operator = "timesplat.preset_add"


class _Sidebar:
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "Timesplat"


class TIMESPLAT_PT_panel(_Sidebar, bpy.types.Panel):
    bl_label = "Timesplat"
    bl_order = 1

    def draw_header_preset(self, context):
        TIMESPLAT_PT_presets.draw_panel_header(self.layout)

    def draw(self, context):
        layout, chosen = self.layout, context.scene.timesplat
        row = layout.row(align=True)
        active = presets.active(chosen)
        for key, name, _ in presets.PRESET_ITEMS:
            row.operator("timesplat.preset", text=name, depress=key == active).preset = key
        col = layout.column(align=True)
        try:
            expected = estimates.estimate(chosen, context)
        except InputError as e:
            col.label(text=str(e), icon="ERROR")
        else:
            seconds = expected.rendering + expected.reconstructing
            row = col.row(align=True)
            row.label(text=f"{expected.pictures} pictures", icon="RENDER_RESULT")
            row.label(text=f"about {_duration(seconds)}", icon="TIME")
            about = "at most" if chosen.budget == "NUMBER" else "about"
            col.label(text=f"{about} {_two_digits(expected.gaussians):,} Gaussians", icon="OUTLINER_OB_POINTCLOUD")
            _draw_notices(layout, chosen, context, expected)
        if not worker_options.has_worker_python(context):
            row = layout.row(align=True)
            row.label(text="No runtime yet", icon="ERROR")
            row.operator("preferences.addon_show", text="Set Up", icon="PREFERENCES").module = ADDON
        row = layout.row(align=True)
        row.scale_y = 1.5
        if chosen.source == "SCENE" and settings.part_is_selected(context):
            _reconstruct_button(row, chosen, "Reconstruct Selected", "SELECTED")
            _reconstruct_button(row, chosen, "All")
        else:
            _reconstruct_button(row, chosen)
        job_rows.draw_jobs(layout)
        layout.operator("timesplat.import_asset", icon="IMPORT")


class TIMESPLAT_PT_capture(_Sidebar, bpy.types.Panel):
    bl_label = "Capture"
    bl_parent_id = "TIMESPLAT_PT_panel"

    def draw(self, context):
        layout, chosen = self.layout, context.scene.timesplat
        layout.use_property_split, layout.use_property_decorate = True, False
        layout.prop(chosen, "source")
        if chosen.source == "SCENE":
            layout.prop(chosen, "leave_out")
        if chosen.source == "COLLECTION":
            layout.prop_search(chosen, "collection", bpy.data, "collections", text=" ")
        layout.prop(chosen, "frame_range")
        col = layout.column(align=True)
        if chosen.frame_range == "CUSTOM":
            col.prop(chosen, "frame_start")
            col.prop(chosen, "frame_end")
        row = col.row(align=True)
        row.prop(chosen, "frame_step")
        if chosen.every:
            row.prop(chosen, "every", text="")
        col = layout.column(align=True)
        col.prop(chosen, "size")
        col.prop(chosen, "samples")
        layout.prop(chosen, "lighting")


class TIMESPLAT_PT_cameras(_Sidebar, bpy.types.Panel):
    bl_label = "Cameras"
    bl_parent_id = "TIMESPLAT_PT_panel"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw(self, context):
        layout, chosen = self.layout, context.scene.timesplat
        placed, description = settings.cameras(context)
        layout.label(text=description, icon="OUTLINER_OB_CAMERA")
        if placed:
            layout.prop(chosen, "in_turn")
        grid = layout.grid_flow(columns=2, align=True, even_columns=True)
        names = {key: name for key, name, _ in add_cameras.RIGS}
        for key in (k for k in names if k not in add_cameras.ADVANCED):
            grid.operator("timesplat.add_cameras", text=names[key]).rig = key
        header, body = layout.panel("timesplat_advanced_rigs", default_closed=True)
        header.label(text="Advanced")
        for key in add_cameras.ADVANCED if body else ():
            body.operator("timesplat.add_cameras", text=names[key]).rig = key


class TIMESPLAT_PT_model(_Sidebar, bpy.types.Panel):
    bl_label = "Model"
    bl_parent_id = "TIMESPLAT_PT_panel"
    bl_options = {"DEFAULT_CLOSED"}  # noqa: RUF012

    def draw(self, context):
        layout, chosen = self.layout, context.scene.timesplat
        layout.use_property_split, layout.use_property_decorate = True, False
        layout.prop(chosen, "method")
        layout.prop(chosen, "quality")
        if chosen.quality == "SECONDS":
            layout.prop(chosen, "refine")
            if not chosen.refine:
                layout.label(text="0: no fit, but for fewer Gaussians", icon="INFO")
        layout.prop(chosen, "budget")
        if chosen.budget in ("SHARE", "NUMBER"):
            layout.prop(chosen, chosen.budget.lower(), text=" ")
        layout.prop(chosen, "look")
        layout.prop(chosen, "output")
        if preferences := worker_options.addon_preferences(context):
            layout.prop(preferences, "checkpoint")
            layout.prop(preferences, "device")


class TIMESPLAT_MT_object(bpy.types.Menu):
    """In the Object menu, which is also how the menu search (F3) finds what is in it"""

    bl_label = "Timesplat Capture"

    def draw(self, context):
        layout = self.layout
        _reconstruct_button(layout, context.scene.timesplat)
        layout.operator("timesplat.cancel")
        layout.operator("timesplat.bring")
        layout.operator("timesplat.log")
        layout.separator()
        layout.operator_enum("timesplat.add_cameras", "rig")
        layout.separator()
        layout.operator("timesplat.self_test")


def _reconstruct_button(layout, chosen, text: str = "Reconstruct", source: str = "") -> None:
    """The button, with the scene's settings, but for the source where one is given."""
    operator = layout.operator("timesplat.reconstruct", text=text, icon="OUTLINER_DATA_POINTCLOUD")
    for key in settings.KEYS:
        setattr(operator, key, getattr(chosen, key))
    operator.source = source or chosen.source


_last_notices: tuple = (0.0, None, ([], "INFO"))  # when, of what, and what was said


def _notices(chosen, context, expected) -> tuple[list[str], str]:
    """Sentences and their icon; in a scene of many objects those of a moment ago, for the panel is drawn often."""
    global _last_notices
    of = context.scene.name, len(context.scene.objects), *(getattr(chosen, key) for key in settings.KEYS)
    when, what, said = _last_notices
    if len(context.scene.objects) > settings.MANY and what == of and time.monotonic() - when < FRESH_SECONDS:
        return said
    try:
        said = notices.notices(chosen, context, expected), "INFO"
    except InputError as e:
        said = [str(e)], "ERROR"
    _last_notices = time.monotonic(), of, said
    return said


def _draw_notices(layout, chosen, context, expected) -> None:
    said, icon = _notices(chosen, context, expected)
    column = layout.column(align=True)
    column.scale_y = 0.8
    for sentence in said:
        for i, line in enumerate(textwrap.wrap(sentence, 34)):
            column.label(text=line, icon="BLANK1" if i else icon)


def _menu(self, context):
    self.layout.menu("TIMESPLAT_MT_object")


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"


def _two_digits(count: int) -> int:
    """Two digits of it: more are not known."""
    return round(count, 2 - len(str(count)))


CLASSES = (
    TIMESPLAT_PT_presets,
    TIMESPLAT_PT_panel,
    TIMESPLAT_PT_capture,
    TIMESPLAT_PT_cameras,
    TIMESPLAT_PT_model,
    TIMESPLAT_MT_object,
)
register_classes, unregister_classes = bpy.utils.register_classes_factory(CLASSES)


def register() -> None:
    register_classes()
    bpy.types.VIEW3D_MT_object.append(_menu)


def unregister() -> None:
    bpy.types.VIEW3D_MT_object.remove(_menu)
    unregister_classes()
