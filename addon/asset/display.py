# SPDX-License-Identifier: GPL-3.0-or-later
"""Puts an Asset into the scene: a point cloud that Geometry Nodes (nodes.py) move and fade from Scene Time.

The point cloud holds the Gaussians at their own times, with the attributes
    gs_velocity, gs_t, gs_sigma_t, gs_opacity      the 4D parameters (time -1..1 over the clip)
    gs_scale, gs_rotation                          σ along the axes, quaternion of the axes
    gs_color                                       LINEAR colour: the asset's sRGB is converted here, once,
                                                   because Blender blends in linear light
    gs_order                                       a random order in 0..1, for the slider Density
    gs_radius, gs_reach, gs_row_0..2               radius of Points and Splats; rows of (R S)⁻¹ for the shader
    those of ellipsoids.py                         for the look Ellipsoids
    those of tracks.py                             where Gaussians ride on paths
and the modifier evaluates positions, `gs_alpha` (opacity at the moment) and radius. Looks: Ellipsoids are opaque
solids; Points are opaque dots, fastest; Splats are spheres of three σ whose shader computes gs_alpha · exp(-½ d²) with
d the distance, in σ, at which the view ray passes the centre. Custom properties of the object: `timesplat` (1: it is
an asset), `timesplat_clip` (the Clip), and what others note there (`timesplat_source`: names of the original objects).
"""

from __future__ import annotations

import math
from dataclasses import asdict, replace

import bpy
import numpy as np

from ...model.io.asset import VISIBLE, Asset, Clip, linear_from_srgb, rotation_matrices
from . import nodes
from .attributes import write_attributes
from .ellipsoids import ellipsoid_attributes
from .sliders import NATIVE, set_input
from .tracks import knots_object, track_attributes

SPLAT_RADIUS = 3.0  # radius of a splat's sphere in σ
THINNEST_SIGMA = 1e-3  # σ of the shader's splats is at least this times the largest one, for float32's sake
TRANSPARENT_BOUNCES = 1024  # how many surfaces a ray may pass; a splat is one, in Cycles without Embree two


def add_asset(asset: Asset, name: str, *, look: str = "Automatic", cut: float = VISIBLE, context=None):
    """Links a new point cloud object that plays the asset, selected and active; returns it. Its transform
    is the normalisation, so that it lies over what it was made from. `cut`: opacity below which a Gaussian
    is left out at a moment. Needs Object Mode; raises the scene's limit of transparent bounces. Raises InputError where
    its paths have too many knots."""
    context = context or bpy.context
    tracks = {"Paths": knots_object(asset.paths, name)} if asset.paths is not None else {}
    ob = point_cloud(asset.xyz, name, context)
    scale, translation = asset.clip.scale, asset.clip.translation
    ob.scale, ob.location = (scale,) * 3, translation
    ob["timesplat"] = 1  # captures leave assets out
    ob["timesplat_clip"] = asdict(asset.clip)
    write_attributes(ob.data, attributes(asset))
    modifier = ob.modifiers.new("Timesplat", "NODES")
    modifier.node_group = nodes.node_group(has_point_clouds(), tracked=bool(tracks))
    for key, value in {
        "Look": look,
        "Opacity Cut": float(cut),
        "Frame Start": float(asset.clip.frame_start),
        "Frame End": float(asset.clip.frame_end),
        **tracks,
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
    """(name, kind, array of N rows) of every attribute of the data but the position."""
    soft = asset.soft_scale()  # Cycles does not blur by a share of a pixel as splat rasterisers do
    scale = np.maximum(soft, THINNEST_SIGMA * soft.max(1, keepdims=True))
    offset, rotation = (None, asset.rotation) if asset.paths is None else asset.on_path()
    rows = (rotation_matrices(rotation) / scale[:, None, :]).transpose(0, 2, 1)  # (RS)⁻¹ = S⁻¹ Rᵀ
    color = np.concatenate([linear_from_srgb(asset.rgb), np.ones((len(asset), 1), np.float32)], 1)
    order = np.random.default_rng(0).permutation(len(asset)) / len(asset)
    found = [
        ("gs_velocity", "FLOAT_VECTOR", asset.velocity),
        ("gs_t", "FLOAT", asset.t),
        ("gs_sigma_t", "FLOAT", asset.sigma_t),
        ("gs_opacity", "FLOAT", asset.opacity),
        ("gs_scale", "FLOAT_VECTOR", asset.scale),
        ("gs_rotation", "QUATERNION", asset.rotation),
        ("gs_color", "FLOAT_COLOR", color),
        ("gs_order", "FLOAT", order),
        ("gs_radius", "FLOAT", np.sort(soft, 1)[:, 1]),  # covers a flat splat's face
        ("gs_reach", "FLOAT", SPLAT_RADIUS * scale.max(1)),
        *((f"gs_row_{i}", "FLOAT_VECTOR", rows[:, i]) for i in range(3)),
        *ellipsoid_attributes(soft, rotation),
    ]
    if asset.paths is not None:
        found += track_attributes(asset, offset)
    return found + (nodes.native_attributes(replace(asset, rotation=rotation)) if NATIVE else [])
