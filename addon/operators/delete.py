# SPDX-License-Identifier: GPL-3.0-or-later
"""Deletes Gaussians for good: by what they are (`timesplat.delete`), or in a rectangle that is dragged over them
(`timesplat.delete_rectangle`)."""

from __future__ import annotations

import bpy
import gpu
import numpy as np
from bpy.props import EnumProperty, FloatProperty, IntProperty
from gpu_extras.batch import batch_for_shader
from mathutils import Matrix

from ...datagen.sequence import InputError
from ..asset.apply_sliders import in_crop_box, peak_opacity, shown_gaussians
from ..asset.asset_object import asset_of, slider_values
from ..asset.edit import keep_gaussians
from .common import OnAsset, errors_reported


class _Delete(OnAsset):
    """An operator that deletes the Gaussians that `to_delete` names."""

    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def execute(self, context):
        ob = context.object
        with errors_reported(self):
            mask = self.to_delete(context, ob)
            if mask.any():
                keep_gaussians(ob, ~mask, context)
            self.report({"INFO"}, f"{mask.sum()} of {len(mask)} Gaussians deleted.")
            return {"FINISHED"} if mask.any() else {"CANCELLED"}
        return {"CANCELLED"}


class TIMESPLAT_OT_delete(_Delete, bpy.types.Operator):
    """Delete Gaussians for good: exports lack them too"""

    bl_idname = "timesplat.delete"
    bl_label = "Delete Gaussians"

    what: EnumProperty(
        name="What",
        items=[
            ("OUTSIDE", "Outside the Crop Box", "Those whose own position is outside Crop Min..Crop Max"),
            ("INSIDE", "Inside the Crop Box", "Those whose own position is inside Crop Min..Crop Max"),
            ("FAINT", "Faint", "Those that never become as opaque as the limit"),
            ("LARGE", "Large", "Those whose longest standard deviation is above the limit"),
        ],
    )
    opacity: FloatProperty(name="Opacity", description="Limit of Faint", default=0.1, min=0, max=1)
    size: FloatProperty(name="Size", description="Limit of Large, in units of the clip", default=0.1, min=0)

    def draw(self, context):
        self.layout.use_property_split = True
        self.layout.prop(self, "what")
        if self.what in ("FAINT", "LARGE"):
            self.layout.prop(self, "opacity" if self.what == "FAINT" else "size")

    def to_delete(self, context, ob) -> np.ndarray:
        asset, s = asset_of(ob), slider_values(ob)
        if self.what == "FAINT":
            return peak_opacity(asset) < np.float32(self.opacity)
        if self.what == "LARGE":
            return asset.scale.max(1) > np.float32(self.size)
        inside = in_crop_box(asset, s)
        return inside if self.what == "INSIDE" else ~inside


class TIMESPLAT_OT_delete_rectangle(_Delete, bpy.types.Operator):
    """Delete the Gaussians that are visible now and whose centres lie in a rectangle that you drag"""

    bl_idname = "timesplat.delete_rectangle"
    bl_label = "Delete in Rectangle"

    xmin: IntProperty(options={"SKIP_SAVE"})
    xmax: IntProperty(options={"SKIP_SAVE"})
    ymin: IntProperty(options={"SKIP_SAVE"})
    ymax: IntProperty(options={"SKIP_SAVE"})

    def to_delete(self, context, ob) -> np.ndarray:
        view, width, height = _projection(context)
        position, visible = shown_gaussians(ob, context.scene.frame_current_final)
        matrix = np.array(view @ ob.matrix_world)
        x, y, _, w = matrix[:, :3] @ position.T.astype(np.float64) + matrix[:, 3:]
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = (x / w / 2 + 0.5) * width, (y / w / 2 + 0.5) * height
            within = (x >= self.xmin) & (x <= self.xmax) & (y >= self.ymin) & (y <= self.ymax)
        return visible & (w > 0) & within

    def invoke(self, context, event):
        if not context.area or context.area.type != "VIEW_3D":
            return self.execute(context)
        self.region = next(r for r in context.area.regions if r.type == "WINDOW")
        self.first_corner = self.mouse = None
        self.draw_handler = bpy.types.SpaceView3D.draw_handler_add(self._draw, (), "WINDOW", "POST_PIXEL")
        context.window.cursor_modal_set("CROSSHAIR")
        context.workspace.status_text_set("Drag a rectangle over the Gaussians to delete.  Esc: cancel")
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        self.mouse = (event.mouse_x - self.region.x, event.mouse_y - self.region.y)
        self.region.tag_redraw()
        if event.type in {"ESC", "RIGHTMOUSE"}:
            self.cancel(context)
            return {"CANCELLED"}
        if event.type == "LEFTMOUSE" and event.value == "PRESS":
            self.first_corner = self.mouse
        elif event.type == "LEFTMOUSE" and event.value == "RELEASE" and self.first_corner:
            self.cancel(context)
            corners = zip(self.first_corner, self.mouse, strict=True)
            (self.xmin, self.xmax), (self.ymin, self.ymax) = map(sorted, corners)
            return self.execute(context)
        elif not self.first_corner and event.type not in {"MOUSEMOVE", "LEFTMOUSE"}:
            return {"PASS_THROUGH"}  # turn the view, go to another frame
        return {"RUNNING_MODAL"}

    def cancel(self, context):
        bpy.types.SpaceView3D.draw_handler_remove(self.draw_handler, "WINDOW")
        context.window.cursor_modal_restore()
        context.workspace.status_text_set(None)
        self.region.tag_redraw()

    def _draw(self):
        if not self.first_corner or bpy.context.region != self.region:
            return
        (a, b), (c, d) = self.first_corner, self.mouse
        shader = gpu.shader.from_builtin("UNIFORM_COLOR")
        lines = batch_for_shader(shader, "LINE_STRIP", {"pos": [(a, b), (c, b), (c, d), (a, d), (a, b)]})
        shader.uniform_float("color", (1, 1, 1, 1))
        lines.draw(shader)


def _projection(context) -> tuple[Matrix, int, int]:
    """(matrix from the world to the view's clip space, width, height in pixels) of the 3D view, or without one of
    the scene's camera and picture. Raises InputError where there is neither."""
    if context.area and context.area.type == "VIEW_3D":
        region = next(r for r in context.area.regions if r.type == "WINDOW")
        return context.space_data.region_3d.perspective_matrix, region.width, region.height
    scene, camera = context.scene, context.scene.camera
    if camera is None:
        raise InputError(f"{scene.name}: there is no 3D view and no camera to look through; add a camera.")
    render = scene.render
    width, height = (round(x * render.resolution_percentage / 100) for x in (render.resolution_x, render.resolution_y))
    aspect = {"scale_x": render.pixel_aspect_x, "scale_y": render.pixel_aspect_y}
    lens = camera.calc_matrix_camera(context.evaluated_depsgraph_get(), x=width, y=height, **aspect)
    return lens @ camera.matrix_world.inverted(), width, height


register, unregister = bpy.utils.register_classes_factory((TIMESPLAT_OT_delete, TIMESPLAT_OT_delete_rectangle))
