# SPDX-License-Identifier: GPL-3.0-or-later
"""Presets of the settings: Draft, Balanced and Fine, and those that artists make."""

import bpy
from bl_operators.presets import AddPresetBase
from bpy.props import EnumProperty

from .. import settings

PRESETS = {  # what they differ in
    "DRAFT": {"size": 128, "samples": 8, "method": "tracks", "budget": "ALL", "refine": 0.0},
    "BALANCED": {"size": 256, "samples": 16, "method": "tracks", "budget": "ALL", "refine": 15.0},
    "FINE": {"size": 512, "samples": 16, "method": "tracks", "budget": "ALL", "refine": 90.0},
}
PRESET_ITEMS = [
    ("DRAFT", "Draft", "Small pictures, and their colours as they are: nothing is fitted"),
    ("BALANCED", "Balanced", "Pictures of 256 pixels, a fit of a quarter of a minute"),
    ("FINE", "Fine", "Larger pictures, a longer fit"),
]


class TIMESPLAT_OT_preset(bpy.types.Operator):
    """Choose resolution, samples, method, refinement and number of Gaussians at once"""

    bl_idname = "timesplat.preset"
    bl_label = "Timesplat Preset"
    bl_options = {"UNDO"}  # noqa: RUF012

    preset: EnumProperty(name="Preset", items=PRESET_ITEMS)

    def execute(self, context):
        for key, value in PRESETS[self.preset].items():
            setattr(context.scene.timesplat, key, value)
        return {"FINISHED"}


class TIMESPLAT_OT_preset_add(AddPresetBase, bpy.types.Operator):
    """Add or remove a preset of your own"""

    bl_idname = "timesplat.preset_add"
    bl_label = "Add Timesplat Preset"
    preset_menu = "TIMESPLAT_PT_presets"
    preset_subdir = "timesplat"
    preset_defines = ("settings = bpy.context.scene.timesplat",)
    preset_values = tuple(f"settings.{k}" for k in settings.KEYS if k not in ("collection", "output"))


register, unregister = bpy.utils.register_classes_factory((TIMESPLAT_OT_preset, TIMESPLAT_OT_preset_add))
