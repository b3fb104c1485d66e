# SPDX-License-Identifier: GPL-3.0-or-later
"""What an asset object holds, as an Asset; deleting Gaussians for good; baking the sliders.

    asset_of(ob)     exactly what the object holds, without its sliders
    applied(ob)      with its sliders, as exactly as the 4D form allows (what export and bake take)
    keep(ob, mask)   throws Gaussians away, and leaves everything else of the object alone

Operators: `timesplat.delete_rectangle`, `timesplat.delete`, `timesplat.bake`. The object's own transform is no part
of the asset: the asset's clip says where it was made, and an object that was moved since stays so in Blender only.
"""

from __future__ import annotations

from dataclasses import replace

import bpy
import gpu
import numpy as np
from bpy.props import EnumProperty, FloatProperty, IntProperty
from gpu_extras.batch import batch_for_shader
from mathutils import Matrix

from ..datagen.sequence import InputError
from ..model.asset import ARRAYS, STATIC_SIGMA_T, Asset, Clip, check
from . import display, nodes

FRAME = 1e-3  # frames: sliders are float32, so that a clip's end may miss a whole frame by as much


# ---------------------------------------------------------------- reading


def _read(data, name: str, width: int, key: str) -> np.ndarray:
    """An attribute as float32 (N,) or, for a width above 1, (N,width)."""
    attribute = data.attributes[name]
    values = np.empty(len(attribute.data) * width, np.float32)
    attribute.data.foreach_get(key, values)
    return values.reshape(-1, width) if width > 1 else values


def asset_of(ob) -> Asset:
    """The Gaussians that the object holds and the clip it remembers: what was put in, to the last bit, but for
    colours, which took the way to linear light and back (an error below 1e-6, and values outside 0..1 are
    clamped). Raises InputError where the object is no asset, or was damaged."""
    if not display.is_asset(ob):
        raise InputError(f"{ob.name if ob else 'Nothing'}: it is no Timesplat asset; select one.")
    try:
        return _asset(ob)
    except KeyError as e:
        raise InputError(f"{ob.name}: the attribute {e} is missing; import or reconstruct the asset again.") from None


def _asset(ob) -> Asset:
    data = ob.data
    asset = Asset(
        xyz=_read(data, "position", 3, "vector"),
        t=_read(data, "gs_t", 1, "value"),
        velocity=_read(data, "gs_velocity", 3, "vector"),
        sigma_t=_read(data, "gs_sigma_t", 1, "value"),
        scale=_read(data, "gs_scale", 3, "vector"),
        rotation=_read(data, "gs_rotation", 4, "value"),
        rgb=_srgb(_read(data, "gs_color", 4, "color")[:, :3]),
        opacity=_read(data, "gs_opacity", 1, "value"),
        clip=_clip(ob),
    )
    check(asset, ob.name)
    return asset


def _srgb(linear: np.ndarray) -> np.ndarray:
    x = linear.astype(np.float64)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055).astype(np.float32)


def _clip(ob) -> Clip:
    if "timesplat_clip" in ob:
        found = ob["timesplat_clip"].to_dict()
        return Clip(**{**found, "translation": tuple(found["translation"])})
    start, end = (round(nodes.get_input(display.sampler(ob), f"Frame {x}")) for x in ("Start", "End"))
    fps = bpy.context.scene.render.fps / bpy.context.scene.render.fps_base
    return Clip(fps, start, end, ob.scale[0], tuple(ob.location))  # made by an older version, which noted no clip


def sliders(ob) -> dict:
    """The modifier's inputs by name, as they are at this moment (an animated one has its present value)."""
    modifier = display.sampler(ob)
    return {name: nodes.get_input(modifier, name) for name in nodes.SLIDERS}


# ---------------------------------------------------------------- the sliders in numbers


def clip_frame(s: dict, frame: float) -> float:
    """Frames since the clip's start that the sliders `s` show at a scene frame; see nodes.py."""
    length = max(s["Frame End"] - s["Frame Start"], 0)
    since = (frame - s["Frame Start"] - s["Time Offset"]) * s["Time Scale"]
    if s["Repeat"] == "Loop":
        return min(since % (length + 1), length)
    if s["Repeat"] == "Ping-Pong" and length:
        return length - abs(since % (2 * length) - length)
    return min(max(since, 0), length)


def model_time(s: dict, frame: float) -> float:
    """Model time, -1..1, that the sliders show at a scene frame."""
    length = max(s["Frame End"] - s["Frame Start"], 0)
    return 2 * clip_frame(s, frame) / length - 1 if length else 0.0


def in_box(asset: Asset, s: dict) -> np.ndarray:
    """(N,) whether a Gaussian's own position lies in the crop box, its faces included."""
    low, high = (np.float32(s[f"Crop {x}"]) for x in ("Min", "Max"))
    return ((asset.xyz >= low) & (asset.xyz <= high)).all(1)


def _chosen(ob, asset: Asset, s: dict) -> np.ndarray:
    """(N,) which Gaussians Density and Crop leave in, at any time."""
    mask = np.ones(len(asset), bool)
    if "gs_order" in ob.data.attributes:
        mask = _read(ob.data, "gs_order", 1, "value") < np.float32(s["Density"])
    return mask & in_box(asset, s) if s["Crop"] else mask


def shown(ob, frame: float) -> tuple[np.ndarray, np.ndarray]:
    """(N,3) positions in normalised space of ALL Gaussians at a scene frame, and (N,) which of them the
    modifier shows then."""
    asset, s = asset_of(ob), sliders(ob)
    chosen = _chosen(ob, asset, s)
    asset.sigma_t = asset.sigma_t * np.float32(s["Lifetime Scale"])
    position, alpha = asset.at(model_time(s, frame))
    return position, chosen & (alpha >= np.float32(s["Opacity Cut"]))


def peak(asset: Asset) -> np.ndarray:
    """(N,) the highest opacity of each Gaussian within the clip."""
    short = np.maximum(np.abs(asset.t) - 1, 0) / asset.sigma_t
    with np.errstate(under="ignore"):
        return asset.opacity * np.exp(-0.5 * short**2)


def applied(ob, frames: tuple[int, int] | None = None) -> Asset:
    """The asset with the sliders' effect for good; `frames`: only these scene frames, both included.

    Density, Crop and Lifetime Scale are exact. Time Offset and Time Scale become another clip and another rate of
    time: the asset shows at each scene frame of its clip what the object shows there. A clip has whole frames at its
    ends: where a retimed one ends between two, it ends at the frame before. What never reaches Opacity Cut is
    left out; the rest fades out as usual, below the cut too. Point Size and Look are no part of an asset.
    Raises InputError where Repeat is not Hold, or nothing is left."""
    asset, s = asset_of(ob), sliders(ob)
    if s["Repeat"] != "Hold":
        raise InputError(f"{ob.name}: Repeat is {s['Repeat']}, and an asset only holds at its ends; set it to Hold.")
    asset = _masked(asset, _chosen(ob, asset, s))
    asset.sigma_t = asset.sigma_t * np.float32(s["Lifetime Scale"])
    if len(asset):
        asset = _retimed(asset, s, frames)
        asset = _masked(asset, peak(asset) >= np.float32(s["Opacity Cut"]))
    if not len(asset):
        raise InputError(f"{ob.name}: no Gaussian is left; lower Opacity Cut, or change Density and Crop.")
    check(asset, ob.name)
    return asset


def _masked(asset: Asset, mask: np.ndarray) -> Asset:
    return replace(asset, **{name: getattr(asset, name)[mask] for name in ARRAYS})


def _retimed(asset: Asset, s: dict, frames: tuple[int, int] | None) -> Asset:
    """Model time is `a` times the new one plus `b`."""
    start, speed = s["Frame Start"] + s["Time Offset"], s["Time Scale"]
    length = max(s["Frame End"] - s["Frame Start"], 0)
    moves = length > 0 and speed != 0
    ends = sorted((start, start + length / speed)) if moves else frames or (start, start + length)
    first, last = int(np.ceil(ends[0] - FRAME)), int(np.floor(ends[1] + FRAME))
    if frames and moves:
        first, last = max(first, frames[0]), min(last, frames[1])
    if moves and last <= first:  # of the clip there is one frame, or none: its end is held
        first = last = first if first == last or not frames else frames[0]
    if last <= first or not moves:
        clip = replace(asset.clip, frame_start=first, frame_end=max(first, last))
        return _frozen(asset, model_time(s, first), clip)
    clip = replace(asset.clip, frame_start=first, frame_end=last)
    a = speed * (last - first) / length
    b = 2 * speed * (first - start) / length - 1 + a
    return replace(
        asset,
        t=((asset.t.astype(np.float64) - b) / a).astype(np.float32),
        sigma_t=(asset.sigma_t.astype(np.float64) / abs(a)).astype(np.float32),
        velocity=(asset.velocity.astype(np.float64) * a).astype(np.float32),
        clip=clip,
    )


def _frozen(asset: Asset, time: float, clip: Clip) -> Asset:
    """What is there at one time, for all time."""
    position, alpha = asset.at(time)
    n = len(asset)
    still = {"t": np.zeros(n), "velocity": np.zeros((n, 3)), "sigma_t": np.full(n, STATIC_SIGMA_T)}
    still = {key: a.astype(np.float32) for key, a in still.items()}
    return replace(asset, xyz=position, opacity=alpha, clip=clip, **still)


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

    active, selected = context.view_layer.objects.active, list(context.view_layer.objects.selected)
    helper = display.point_cloud(xyz, old.name, context)  # a PointCloud cannot be resized before Blender 5.2
    new = helper.data
    for name, kind, key, values in kept:
        attribute = new.attributes.get(name) or new.attributes.new(name, kind, "POINT")
        attribute.data.foreach_set(key, values.ravel())
    for material in old.materials:
        new.materials.append(material)
    for key in old.keys():  # noqa: SIM118
        new[key] = old[key]
    name = old.name
    old.user_remap(new)
    bpy.data.objects.remove(helper)
    bpy.data.batch_remove([old])
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
        clip = f"frames {new['timesplat_clip']['frame_start']} to {new['timesplat_clip']['frame_end']}"
        self.report({"INFO"}, f"{len(_read(new.data, 'gs_t', 1, 'value'))} Gaussians, {clip}.")
        return {"FINISHED"}


def baked(ob, frames: tuple[int, int], context=None):
    """A new object in place of `ob`, which is hidden: see `applied`. It is where `ob` is, and follows it where
    that is animated. Raises InputError."""
    asset, s = applied(ob, frames), sliders(ob)
    new = display.add_asset(asset, f"{ob.name} baked", look=s["Look"], cut=s["Opacity Cut"], context=context)
    nodes.set_input(display.sampler(new), "Point Size", s["Point Size"])
    for key in ob.keys():  # noqa: SIM118
        if key != "timesplat_clip":
            new[key] = ob[key]
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
