# SPDX-License-Identifier: GPL-3.0-or-later
"""Puts an Asset into the scene: a point cloud that Geometry Nodes (nodes.py) move and fade from Scene Time; and
the panel with its sliders.

The point cloud holds the Gaussians at their own times, with the attributes
    gs_velocity, gs_t, gs_sigma_t, gs_opacity      the 4D parameters (time -1..1 over the clip)
    gs_scale, gs_rotation                          σ along the axes, quaternion of the axes
    gs_color                                       LINEAR colour: the asset's sRGB is converted here, once,
                                                   because Blender blends in linear light
    gs_order                                       a random order in 0..1, for the slider Density
    gs_radius, gs_reach, gs_row_0..2               radius of each look; rows of (R S)⁻¹ for the shader
and the modifier evaluates positions, `gs_alpha` (opacity at the moment) and radius. Looks: Points are opaque
dots, fast; Splats are spheres of three σ whose shader computes gs_alpha · exp(-½ d²) with d the distance, in σ,
at which the view ray passes the centre. Custom properties of the object: `timesplat` (1: it is an asset),
`timesplat_clip` (the Clip), and what others note there (`timesplat_source`: names of the original objects).

    python -m timesplat.addon.display asset.ply asset.blend      writes a .blend to look at
"""

from __future__ import annotations

import math
import sys
from dataclasses import asdict
from pathlib import Path

import bpy
import numpy as np

from ..datagen.rigs import CANONICAL, FOV, spherical
from ..datagen.sequence import InputError, Normalisation
from ..model.io.asset import VISIBLE, Asset, Clip, linear_from_srgb, rotation_matrices
from ..model.io.ply import read_ply
from . import nodes
from .nodes import LOOKS, set_input

__all__ = ["LOOKS", "add_asset", "follow", "is_asset", "play_clip", "sampler", "save_blend", "set_input"]

REACH = 3.0  # radius of a splat's sphere in σ
THINNEST = 1e-3  # σ of the shader's splats is at least this times the largest one, for float32's sake
TRANSPARENT_BOUNCES = 1024  # how many surfaces a ray may pass; a splat is one, in Cycles without Embree two


def add_asset(asset: Asset, name: str, *, look: str = "Automatic", cut: float = VISIBLE, context=None):
    """Links a new point cloud object that plays the asset, selected and active; returns it. Its transform
    is the normalisation, so that it lies over what it was made from. `cut`: opacity below which a Gaussian
    is left out at a moment. Needs Object Mode; raises the scene's limit of transparent bounces."""
    context = context or bpy.context
    ob = point_cloud(asset.xyz, name, context)
    scale, translation = asset.clip.scale, asset.clip.translation
    ob.scale, ob.location = (scale,) * 3, translation
    ob["timesplat"] = 1  # captures leave assets out
    ob["timesplat_clip"] = asdict(asset.clip)
    write_attributes(ob.data, attributes(asset))
    modifier = ob.modifiers.new("Timesplat", "NODES")
    modifier.node_group = nodes.group(has_point_clouds())
    for key, value in {
        "Look": look,
        "Opacity Cut": float(cut),
        "Frame Start": float(asset.clip.frame_start),
        "Frame End": float(asset.clip.frame_end),
    }.items():
        set_input(modifier, key, value)
    for material in (nodes.points_material(), nodes.splats_material()):
        ob.data.materials.append(material)
    if hasattr(context.scene, "cycles"):
        cycles = context.scene.cycles
        cycles.transparent_max_bounces = max(cycles.transparent_max_bounces, TRANSPARENT_BOUNCES)
    return ob


def play_clip(scene, clip: Clip) -> None:
    """Gives the scene the clip's frame range and rate (exact for rates that are not whole numbers too)."""
    scene.frame_start, scene.frame_end = clip.frame_start, clip.frame_end
    scene.render.fps = max(1, math.ceil(clip.fps - 1e-6))
    scene.render.fps_base = scene.render.fps / clip.fps
    scene.frame_set(clip.frame_start)


# ---------------------------------------------------------------- data


def has_point_clouds() -> bool:
    """Whether this Blender makes PointCloud objects; 4.2 does not, a mesh of vertices stands in there."""
    return "POINTCLOUD" in bpy.ops.object.convert.get_rna_type().properties["target"].enum_items


def point_cloud(xyz: np.ndarray, name: str, context):
    """A PointCloud cannot be resized, so that it is made by converting a mesh of vertices."""
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(len(xyz))
    mesh.vertices.foreach_set("co", np.ascontiguousarray(xyz, np.float32).ravel())
    ob = bpy.data.objects.new(name, mesh)
    context.collection.objects.link(ob)
    if ob.name not in context.view_layer.objects:  # the active collection is excluded from the view layer
        context.collection.objects.unlink(ob)
        context.scene.collection.objects.link(ob)
    for other in filter(None, context.view_layer.objects.selected):  # None: one that a script has just removed
        other.select_set(False)
    ob.hide_set(False)
    ob.select_set(True)
    context.view_layer.objects.active = ob
    if not has_point_clouds():
        return ob
    bpy.ops.object.convert(target="POINTCLOUD")
    ob = context.view_layer.objects.active
    if mesh.users == 0:
        bpy.data.meshes.remove(mesh)
    ob.data.name = name
    return ob


def attributes(asset: Asset) -> list[tuple]:
    """(name, type, key of its values, array of N rows) of every attribute of the data but the position."""
    soft = asset.soft_scale()  # Cycles does not blur by a share of a pixel as splat rasterisers do
    scale = np.maximum(soft, THINNEST * soft.max(1, keepdims=True))
    rows = (rotation_matrices(asset.rotation) / scale[:, None, :]).transpose(0, 2, 1)  # (RS)⁻¹ = S⁻¹ Rᵀ
    color = np.concatenate([linear_from_srgb(asset.rgb), np.ones((len(asset), 1), np.float32)], 1)
    order = np.random.default_rng(0).permutation(len(asset)) / len(asset)
    found = [
        ("gs_velocity", "FLOAT_VECTOR", "vector", asset.velocity),
        ("gs_t", "FLOAT", "value", asset.t),
        ("gs_sigma_t", "FLOAT", "value", asset.sigma_t),
        ("gs_opacity", "FLOAT", "value", asset.opacity),
        ("gs_scale", "FLOAT_VECTOR", "vector", asset.scale),
        ("gs_rotation", "QUATERNION", "value", asset.rotation),
        ("gs_color", "FLOAT_COLOR", "color", color),
        ("gs_order", "FLOAT", "value", order),
        ("gs_radius", "FLOAT", "value", np.sort(soft, 1)[:, 1]),  # covers a flat splat's face
        ("gs_reach", "FLOAT", "value", REACH * scale.max(1)),
        *((f"gs_row_{i}", "FLOAT_VECTOR", "vector", rows[:, i]) for i in range(3)),
    ]
    return found + (nodes.native_attributes(asset) if nodes.NATIVE else [])


def write_attributes(data, found: list[tuple]) -> None:
    for name, kind, key, values in found:
        attribute = data.attributes.new(name, kind, "POINT")
        attribute.data.foreach_set(key, np.ascontiguousarray(values, np.float32).ravel())


# ---------------------------------------------------------------- the object


def is_asset(ob) -> bool:
    """Whether the object holds Gaussians, so that its sliders are there to be drawn."""
    return bool(ob and ob.get("timesplat") and sampler(ob))


def sampler(ob):
    """The modifier that plays the asset; None if there is none."""
    for modifier in ob.modifiers:
        if modifier.type == "NODES" and modifier.node_group and modifier.node_group.name.startswith("Timesplat "):
            return modifier
    return None


def follow(ob, original) -> bool:
    """Parents the asset to the original, so that moving this moves that; the asset stays where it is. Only where
    the original's transform stands still by itself: with an animated one, a constraint, a driver, physics or an
    animated parent, the motion is in the Gaussians already. Returns whether it did."""
    above = original
    while above:
        if above == ob or _moves(above):
            return False
        above = above.parent
    bpy.context.view_layer.update()
    ob.parent, ob.parent_type = original, "OBJECT"
    ob.matrix_parent_inverse = original.matrix_world.inverted_safe()
    return True


def _moves(ob) -> bool:
    if ob.constraints or ob.rigid_body or (ob.parent and ob.parent_type != "OBJECT"):
        return True
    animation = ob.animation_data
    if not animation:
        return False
    moving = ("location", "rotation", "scale", "delta_")
    if any(curve.data_path.startswith(moving) for curve in animation.drivers):
        return True
    actions = [animation.action, *(s.action for t in animation.nla_tracks for s in t.strips)]
    return any(path.startswith(moving) for a in actions if a for path in _paths(a))


def _paths(action) -> list[str]:
    """Data paths that an action animates; those of all its slots."""
    if not hasattr(action, "layers"):  # before Blender 4.4
        return [c.data_path for c in action.fcurves]
    strips = [s for layer in action.layers for s in layer.strips]
    return [c.data_path for s in strips for bag in s.channelbags for c in bag.fcurves]


# ---------------------------------------------------------------- the panel


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


class _Result:
    bl_label = "Result"
    bl_region_type = "WINDOW"

    @classmethod
    def poll(cls, context):
        return is_asset(context.object)

    def draw(self, context):
        """Only what is at hand: nothing is evaluated, read or counted here."""
        layout, ob = self.layout, context.object
        modifier = sampler(ob)
        layout.use_property_split = True
        count = len(ob.data.points if ob.type == "POINTCLOUD" else ob.data.vertices)
        layout.label(text=f"{count:,} Gaussians", icon="POINTCLOUD_DATA")
        row = layout.row(align=True)
        for what in ("Original", "Both", "Result"):  # operator_enum would put them below one another
            row.operator("timesplat.show", text=what).what = what.upper()
        panel, column = "", layout.column(align=True)
        for name, (group, *_) in nodes.SLIDERS.items():
            found = nodes.rna(modifier, name)
            if found is None or (name in ("Crop Min", "Crop Max") and not nodes.get_input(modifier, "Crop")):
                continue
            if group != panel:
                panel, column = group, layout.column(align=True)
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


CLASSES = (
    TIMESPLAT_OT_set_standard,
    TIMESPLAT_OT_show_colours,
    TIMESPLAT_PT_result,
    TIMESPLAT_PT_result_properties,
)


def register() -> None:
    for cls in CLASSES:
        bpy.utils.register_class(cls)


def unregister() -> None:
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)


# ---------------------------------------------------------------- a .blend of its own


def save_blend(path_ply: str | Path, path_blend: str | Path) -> None:
    """Replaces the open file by a scene with the asset, a camera at the front, a sun and a white world, with
    the clip's range and rate, and saves it. It needs no add-on to be opened, played or rendered."""
    asset = read_ply(path_ply)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    add_asset(asset, Path(path_ply).stem)
    play_clip(scene, asset.clip)
    placed = Normalisation(asset.clip.scale, asset.clip.translation)
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    camera.matrix_world = placed.to_world(spherical(CANONICAL["front"], 0)).T.tolist()
    camera.data.angle = math.radians(FOV)
    camera.data.clip_start, camera.data.clip_end = 0.01 * asset.clip.scale, 100 * asset.clip.scale
    sun = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
    sun.rotation_euler = (0.8, 0.2, 0.5)
    for ob in (camera, sun):
        scene.collection.objects.link(ob)
    scene.camera = camera
    scene.world = bpy.data.worlds.new("White")
    scene.world.use_nodes = True
    next(x for x in scene.world.node_tree.nodes if x.type == "BACKGROUND").inputs[0].default_value = (1, 1, 1, 1)
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising = 16, False
    scene.cycles.min_transparent_bounces = TRANSPARENT_BOUNCES  # no roulette: half the noise in equal time
    scene.render.resolution_x = scene.render.resolution_y = 512
    scene.view_settings.view_transform = "Standard"  # others change the asset's colours
    for screen in bpy.data.screens:
        for space in (a.spaces.active for a in screen.areas if a.type == "VIEW_3D"):
            space.shading.type, space.region_3d.view_perspective = "MATERIAL", "CAMERA"
    path = Path(path_blend).resolve()
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        bpy.ops.wm.save_as_mainfile(filepath=str(path), compress=True, copy=True)
    except RuntimeError as e:
        raise InputError(f"{path}: it cannot be written ({' '.join(str(e).split())}).") from None


if __name__ == "__main__":
    try:
        save_blend(*sys.argv[1:3])
    except InputError as error:
        sys.exit(str(error))
