# SPDX-License-Identifier: GPL-3.0-or-later
"""Presets of the settings: the qualities, each with pictures of its size, and those that artists make."""

import bpy
from bl_operators.presets import AddPresetBase
from bpy.props import EnumProperty

from .. import settings

PRESETS = {  # what they set
    "DRAFT": {"size": 128, "samples": 8, "method": "tracks", "budget": "ALL", "quality": "DRAFT"},
    "BALANCED": {"size": 256, "samples": 16, "method": "tracks", "budget": "ALL", "quality": "BALANCED"},
    "FINE": {"size": 512, "samples": 16, "method": "tracks", "budget": "ALL", "quality": "FINE"},
    "BEST": {"size": 1024, "samples": 16, "method": "tracks", "budget": "ALL", "quality": "BEST"},
}
PRESET_ITEMS = [
    ("DRAFT", "Draft", "Small pictures and a short fit: whether it works at all"),
    ("BALANCED", "Balanced", "Pictures of 256 pixels"),
    ("FINE", "Fine", "Pictures of 512 pixels, a longer fit"),
    ("BEST", "Best", "Pictures of 1024 pixels, and time"),
]


def active(chosen) -> str | None:
    """The preset that the settings are those of."""
    for key, values in PRESETS.items():
        if all(getattr(chosen, name) == value for name, value in values.items()):
            return key
    return None


class TIMESPLAT_OT_preset(bpy.types.Operator):
    """Choose resolution, samples, method, quality and number of Gaussians at once"""

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
