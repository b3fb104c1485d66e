# SPDX-License-Identifier: GPL-3.0-or-later
"""Deleting Gaussians for good, and baking the sliders: `timesplat.delete_rectangle`, `timesplat.delete`,
`timesplat.bake`. What an object holds is said by `asset_of` and `applied` (held.py)."""

from __future__ import annotations

import bpy
import gpu
import numpy as np
from bpy.props import EnumProperty, FloatProperty, IntProperty
from gpu_extras.batch import batch_for_shader
from mathutils import Matrix

from ...datagen.sequence import InputError
from ..asset import display, nodes
from ..asset.asset_object import applied, asset_of, in_box, peak, shown, sliders

# ---------------------------------------------------------------- throwing away

_KINDS = {  # of attributes: numbers in a value, key, dtype
    "FLOAT": (1, "value", np.float32),
    "INT": (1, "value", np.int32),
    "BOOLEAN": (1, "value", bool),
    "INT8": (1, "value", np.int8),
    "FLOAT2": (2, "vector", np.float32),
    "FLOAT_VECTOR": (3, "vector", np.float32),
    "FLOAT4": (4, "vector", np.float32),
    "QUATERNION": (4, "value", np.float32),
    "FLOAT_COLOR": (4, "color", np.float32),
    "BYTE_COLOR": (4, "color", np.float32),
}


def keep(ob, mask: np.ndarray, context=None) -> None:
    """Throws away the Gaussians of the object's data where `mask` (N,) is false, for all objects that share the
    data. Attributes, materials and names stay; so does all that belongs to the object. Needs Object Mode. Raises
    InputError where nothing would be left or the data is linked from another file."""
    context = context or bpy.context
    old = ob.data
    if not mask.any():
        raise InputError(f"{ob.name}: no Gaussian would be left; delete the object instead, or choose fewer.")
    if old.library or old.override_library:
        raise InputError(f"{ob.name}: its data is linked from another file; make it local first.")
    kept = []
    for attribute in old.attributes:
        if attribute.domain != "POINT" or attribute.data_type not in _KINDS or attribute.name.startswith("."):
            continue
        width, key, dtype = _KINDS[attribute.data_type]
        values = np.empty(len(mask) * width, dtype)
        attribute.data.foreach_get(key, values)
        kept.append((attribute.name, attribute.data_type, key, values.reshape(len(mask), -1)[mask]))
    xyz = next(values for name, _, _, values in kept if name == "position")

    active, selected = context.view_layer.objects.active, [o for o in context.view_layer.objects.selected if o]
    helper = display.point_cloud(xyz, old.name, context)  # a PointCloud cannot be resized before Blender 5.2
    new = helper.data
    for name, kind, key, values in kept:
        attribute = new.attributes.get(name) or new.attributes.new(name, kind, "POINT")
        attribute.data.foreach_set(key, values.ravel())
    for material in old.materials:
        new.materials.append(material)
    for key, value in old.items():
        new[key] = value.to_dict() if hasattr(value, "to_dict") else value
    name = old.name
    old.user_remap(new)
    bpy.data.objects.remove(helper)
    # not batch_remove: undo after it has crashed Blender 4.3
    (bpy.data.meshes if isinstance(old, bpy.types.Mesh) else bpy.data.pointclouds).remove(old)
    new.name = name
    for other in selected:
        other.select_set(True)
    context.view_layer.objects.active = active


class _Delete:
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context):
        return context.mode == "OBJECT" and display.is_asset(context.object)

    def execute(self, context):
        ob = context.object
        try:
            mask = self.goes(context, ob)
            if mask.any():
                keep(ob, ~mask, context)
        except InputError as e:
            self.report({"ERROR"}, str(e))
            return {"CANCELLED"}
        self.report({"INFO"}, f"{mask.sum()} of {len(mask)} Gaussians deleted.")
        return {"FINISHED"} if mask.any() else {"CANCELLED"}


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

    def goes(self, context, ob) -> np.ndarray:
        asset, s = asset_of(ob), sliders(ob)
        if self.what == "FAINT":
            return peak(asset) < np.float32(self.opacity)
        if self.what == "LARGE":
            return asset.scale.max(1) > np.float32(self.size)
        inside = in_box(asset, s)
        return inside if self.what == "INSIDE" else ~inside


class TIMESPLAT_OT_delete_rectangle(_Delete, bpy.types.Operator):
    """Delete the Gaussians that are visible now and whose centres lie in a rectangle that you drag"""

    bl_idname = "timesplat.delete_rectangle"
    bl_label = "Delete in Rectangle"

    xmin: IntProperty(options={"SKIP_SAVE"})
    xmax: IntProperty(options={"SKIP_SAVE"})
    ymin: IntProperty(options={"SKIP_SAVE"})
    ymax: IntProperty(options={"SKIP_SAVE"})

    def goes(self, context, ob) -> np.ndarray:
        view, width, height = _view(context)
        position, visible = shown(ob, context.scene.frame_current_final)
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
        self.corner = self.at = None
        self.handle = bpy.types.SpaceView3D.draw_handler_add(self._draw, (), "WINDOW", "POST_PIXEL")
        context.window.cursor_modal_set("CROSSHAIR")
        context.workspace.status_text_set("Drag a rectangle over the Gaussians to delete.  Esc: cancel")
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        self.at = (event.mouse_x - self.region.x, event.mouse_y - self.region.y)
        self.region.tag_redraw()
        if event.type in {"ESC", "RIGHTMOUSE"}:
            self.cancel(context)
            return {"CANCELLED"}
        if event.type == "LEFTMOUSE" and event.value == "PRESS":
            self.corner = self.at
        elif event.type == "LEFTMOUSE" and event.value == "RELEASE" and self.corner:
            self.cancel(context)
            (self.xmin, self.xmax), (self.ymin, self.ymax) = map(sorted, zip(self.corner, self.at, strict=True))
            return self.execute(context)
        elif not self.corner and event.type not in {"MOUSEMOVE", "LEFTMOUSE"}:
            return {"PASS_THROUGH"}  # turn the view, go to another frame
        return {"RUNNING_MODAL"}

    def cancel(self, context):
        bpy.types.SpaceView3D.draw_handler_remove(self.handle, "WINDOW")
        context.window.cursor_modal_restore()
        context.workspace.status_text_set(None)
        self.region.tag_redraw()

    def _draw(self):
        if not self.corner or bpy.context.region != self.region:
            return
        (a, b), (c, d) = self.corner, self.at
        shader = gpu.shader.from_builtin("UNIFORM_COLOR")
        lines = batch_for_shader(shader, "LINE_STRIP", {"pos": [(a, b), (c, b), (c, d), (a, d), (a, b)]})
        shader.uniform_float("color", (1, 1, 1, 1))
        lines.draw(shader)


def _view(context) -> tuple[Matrix, int, int]:
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


# ---------------------------------------------------------------- baking


class TIMESPLAT_OT_bake(bpy.types.Operator):
    """Make a new asset of a range of frames with the sliders applied; the original is hidden"""

    bl_idname = "timesplat.bake"
    bl_label = "Bake"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    frame_start: IntProperty(name="Start", description="First frame; by default the scene's", options={"SKIP_SAVE"})
    frame_end: IntProperty(name="End", description="Last frame; by default the scene's", options={"SKIP_SAVE"})

    poll = _Delete.poll

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
        try:
            new = baked(ob, frames, context)
        except InputError as e:
            self.report({"ERROR"}, str(e))
            return {"CANCELLED"}
        clip = new["timesplat_clip"]
        count = len(new.data.attributes["gs_t"].data)
        self.report({"INFO"}, f"{count} Gaussians, frames {clip['frame_start']} to {clip['frame_end']}.")
        return {"FINISHED"}


def baked(ob, frames: tuple[int, int], context=None):
    """A new object in place of `ob`, which is hidden: see `applied`. It is where `ob` is, and follows it where
    that is animated. Raises InputError."""
    asset, s = applied(ob, frames), sliders(ob)
    new = display.add_asset(asset, f"{ob.name} baked", look=s["Look"], cut=s["Opacity Cut"], context=context)
    nodes.set_input(display.sampler(new), "Point Size", s["Point Size"])
    for key, value in ob.items():
        if key.startswith("timesplat_") and key != "timesplat_clip":
            new[key] = value
    if ob.animation_data or ob.constraints:
        new.parent = ob
        new.matrix_basis = Matrix()
    else:
        new.parent, new.parent_type, new.parent_bone = ob.parent, ob.parent_type, ob.parent_bone
        new.matrix_parent_inverse, new.matrix_basis = ob.matrix_parent_inverse, ob.matrix_basis
    ob.hide_set(True)
    ob.hide_render = True
    return new


# ---------------------------------------------------------------- registering


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
    if display.is_asset(context.object):
        self.layout.menu("TIMESPLAT_MT_result")


CLASSES = (TIMESPLAT_OT_delete, TIMESPLAT_OT_delete_rectangle, TIMESPLAT_OT_bake, TIMESPLAT_MT_result)


def register() -> None:
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.VIEW3D_MT_object.append(_menu)


def unregister() -> None:
    bpy.types.VIEW3D_MT_object.remove(_menu)
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
