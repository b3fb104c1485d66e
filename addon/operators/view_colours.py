# SPDX-License-Identifier: GPL-3.0-or-later
"""Makes a 3D view and the scene show an asset's colours as they are.

Ellipsoids are a mesh with a colour of its own, which Solid shows at once, flat and through no view transform; of other
looks only Material Preview knows the colour."""

from __future__ import annotations

import bpy

from ..asset.sliders import asset_modifier, get_input, is_asset


class TIMESPLAT_OT_set_standard(bpy.types.Operator):
    """Show colours as they are: the view transform Standard. Others, like AgX, change the asset's colours"""

    bl_idname = "timesplat.set_standard"
    bl_label = "Set Standard"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def execute(self, context):
        context.scene.view_settings.view_transform = "Standard"
        return {"FINISHED"}


def shows_colours(shading, ob) -> bool:
    """Whether a 3D view shows the colours of an asset object."""
    if shading.type in ("MATERIAL", "RENDERED"):
        return True
    flat = (shading.type, shading.light, shading.color_type) == ("SOLID", "FLAT", "VERTEX")
    return flat and _is_mesh(ob)


def _is_mesh(ob) -> bool:
    return is_asset(ob) and get_input(asset_modifier(ob), "Look") in ("Automatic", "Ellipsoids")


class TIMESPLAT_OT_show_colours(bpy.types.Operator):
    """Show the colours in this 3D view: Solid with flat light and the colours of attributes"""

    bl_idname = "timesplat.show_colours"
    bl_label = "Show Colours"

    @classmethod
    def poll(cls, context):
        return context.area is not None and context.area.type == "VIEW_3D"

    def execute(self, context):
        shading = context.space_data.shading
        if not _is_mesh(context.object):
            shading.type = "MATERIAL"
        elif not shows_colours(shading, context.object):
            shading.type, shading.light, shading.color_type = "SOLID", "FLAT", "VERTEX"
        return {"FINISHED"}


register, unregister = bpy.utils.register_classes_factory((TIMESPLAT_OT_set_standard, TIMESPLAT_OT_show_colours))
