# SPDX-License-Identifier: GPL-3.0-or-later
"""Puts an Asset into the scene: a point cloud that Geometry Nodes move and fade from Scene Time.

Everything that plays is in the .blend, at fractional frames too: it opens and scrubs without this add-on.
The point cloud holds the Gaussians at their own times, with the attributes
    gs_velocity, gs_t, gs_sigma_t, gs_opacity      the 4D parameters (time -1..1 over the clip)
    gs_scale, gs_rotation                          σ along the axes, quaternion of the axes
    gs_color                                       LINEAR colour: the asset's sRGB is converted here, once,
                                                   because Blender blends in linear light
    gs_radius, gs_reach, gs_row_0..2               radius of each look; rows of (R S)⁻¹ for the shader
and the modifier evaluates positions, `gs_alpha` (opacity at the moment) and radius, and takes out what is
fainter than its Opacity Cut. Looks: Points are opaque dots, fast; Splats are spheres of three σ whose shader
computes gs_alpha · exp(-½ d²) with d the distance, in σ, at which the view ray passes the centre.

    python -m timesplat.addon.display asset.ply asset.blend      writes a .blend to look at
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import bpy
import numpy as np

from ..datagen.rigs import CANONICAL, FOV, spherical
from ..datagen.sequence import InputError, Normalisation
from ..model.asset import VISIBLE, Asset, Clip, linear_from_srgb, read_ply, rotation_matrices

GROUP = "Timesplat 1"  # the number counts versions of the node group, so that old files keep theirs
LOOKS = ("Automatic", "Points", "Splats")  # Automatic: Points in the viewport, Splats in renders
REACH = 3.0  # radius of a splat's sphere in σ
THINNEST = 1e-3  # σ of the shader's splats is at least this times the largest one, for float32's sake
TRANSPARENT_BOUNCES = 512  # how many splats a ray may pass


def add_asset(asset: Asset, name: str, *, look: str = "Automatic", cut: float = VISIBLE, context=None):
    """Links a new point cloud object that plays the asset, selected and active; returns it. Its transform
    is the normalisation, so that it lies over what it was made from. `cut`: opacity below which a Gaussian
    is left out at a moment. Needs Object Mode; raises the scene's limit of transparent bounces."""
    context = context or bpy.context
    ob = _point_cloud(asset.xyz, name, context)
    scale, translation = asset.clip.scale, asset.clip.translation
    ob.scale, ob.location = (scale,) * 3, translation
    ob["timesplat"] = 1  # captures leave assets out
    _attributes(ob.data, asset)
    modifier = ob.modifiers.new("Timesplat", "NODES")
    modifier.node_group = _group()
    for key, value in {
        "Look": LOOKS.index(look),
        "Opacity Cut": float(cut),
        "Frame Start": float(asset.clip.frame_start),
        "Frame End": float(asset.clip.frame_end),
    }.items():
        set_input(modifier, key, value)
    for material in (_points_material(), _splats_material()):
        ob.data.materials.append(material)
    if hasattr(context.scene, "cycles"):
        cycles = context.scene.cycles
        cycles.transparent_max_bounces = max(cycles.transparent_max_bounces, TRANSPARENT_BOUNCES)
    return ob


def set_input(modifier, name: str, value) -> None:
    """Sets an input of the modifier by the name it shows ("Look" takes an index into LOOKS)."""
    items = modifier.node_group.interface.items_tree
    identifier = next(i.identifier for i in items if i.name == name and i.in_out == "INPUT")
    modifier[identifier] = value
    modifier.id_data.update_tag()


def play_clip(scene, clip: Clip) -> None:
    """Gives the scene the clip's frame range and rate (exact for rates that are not whole numbers too)."""
    scene.frame_start, scene.frame_end = clip.frame_start, clip.frame_end
    scene.render.fps = max(1, math.ceil(clip.fps - 1e-6))
    scene.render.fps_base = scene.render.fps / clip.fps
    scene.frame_set(clip.frame_start)


# ---------------------------------------------------------------- data


def _has_point_clouds() -> bool:
    """Whether this Blender makes PointCloud objects; 4.2 does not, a mesh of vertices stands in there."""
    return "POINTCLOUD" in bpy.ops.object.convert.get_rna_type().properties["target"].enum_items


def _point_cloud(xyz: np.ndarray, name: str, context):
    """A PointCloud cannot be resized, so that it is made by converting a mesh of vertices."""
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(len(xyz))
    mesh.vertices.foreach_set("co", np.ascontiguousarray(xyz, np.float32).ravel())
    ob = bpy.data.objects.new(name, mesh)
    context.collection.objects.link(ob)
    if ob.name not in context.view_layer.objects:  # the active collection is excluded from the view layer
        context.collection.objects.unlink(ob)
        context.scene.collection.objects.link(ob)
    for other in context.view_layer.objects.selected:
        other.select_set(False)
    ob.hide_set(False)
    ob.select_set(True)
    context.view_layer.objects.active = ob
    if not _has_point_clouds():
        return ob
    bpy.ops.object.convert(target="POINTCLOUD")
    ob = context.view_layer.objects.active
    if mesh.users == 0:
        bpy.data.meshes.remove(mesh)
    ob.data.name = name
    return ob


def _attributes(cloud, asset: Asset) -> None:
    soft = asset.soft_scale()  # Cycles does not blur by a share of a pixel as splat rasterisers do
    scale = np.maximum(soft, THINNEST * soft.max(1, keepdims=True))
    rows = (rotation_matrices(asset.rotation) / scale[:, None, :]).transpose(0, 2, 1)  # (RS)⁻¹ = S⁻¹ Rᵀ
    color = np.concatenate([linear_from_srgb(asset.rgb), np.ones((len(asset), 1), np.float32)], 1)
    for name, kind, key, values in (
        ("gs_velocity", "FLOAT_VECTOR", "vector", asset.velocity),
        ("gs_t", "FLOAT", "value", asset.t),
        ("gs_sigma_t", "FLOAT", "value", asset.sigma_t),
        ("gs_opacity", "FLOAT", "value", asset.opacity),
        ("gs_scale", "FLOAT_VECTOR", "vector", asset.scale),
        ("gs_rotation", "QUATERNION", "value", asset.rotation),
        ("gs_color", "FLOAT_COLOR", "color", color),
        ("gs_radius", "FLOAT", "value", np.sort(soft, 1)[:, 1]),  # covers a flat splat's face
        ("gs_reach", "FLOAT", "value", REACH * scale.max(1)),
        *((f"gs_row_{i}", "FLOAT_VECTOR", "vector", rows[:, i]) for i in range(3)),
    ):
        attribute = cloud.attributes.new(name, kind, "POINT")
        attribute.data.foreach_set(key, np.ascontiguousarray(values, np.float32).ravel())


# ---------------------------------------------------------------- nodes


class _Nodes:
    """Writes node trees as expressions: every method adds a node and returns its first visible output."""

    def __init__(self, tree) -> None:
        self.tree = tree

    def add(self, kind: str, *inputs, **settings):
        """A node with its settings and its visible inputs in order (a socket, a value, None = default)."""
        node = self.tree.nodes.new(kind)
        for key, value in settings.items():
            setattr(node, key, value)
        visible = [s for s in node.inputs if s.enabled and not s.is_unavailable]
        for socket, value in zip(visible, inputs, strict=False):
            self.put(socket, value)
        count = len(self.tree.nodes)
        node.location = (190 * (count // 4), -240 * (count % 4))
        return node

    def put(self, socket, value) -> None:
        if isinstance(value, bpy.types.NodeSocket):
            self.tree.links.new(value, socket)
        elif value is not None:
            socket.default_value = value

    def out(self, kind: str, *inputs, **settings):
        return next(s for s in self.add(kind, *inputs, **settings).outputs if s.enabled)

    def math(self, operation: str, *inputs):
        return self.out("ShaderNodeMath", *inputs, operation=operation)

    def vector(self, operation: str, *inputs):
        node = self.add("ShaderNodeVectorMath", *inputs, operation=operation)
        return node.outputs["Value" if operation == "DOT_PRODUCT" else "Vector"]

    def named(self, name: str, kind: str = "FLOAT"):
        return self.out("GeometryNodeInputNamedAttribute", name, data_type=kind)


def _group():
    """The shared node group: made once a file."""
    clouds = _has_point_clouds()
    name = GROUP if clouds else f"{GROUP} Mesh"
    if tree := bpy.data.node_groups.get(name):
        return tree
    tree = bpy.data.node_groups.new(name, "GeometryNodeTree")
    tree.is_modifier = True
    new = tree.interface.new_socket
    new("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    new("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    menu = new("Look", in_out="INPUT", socket_type="NodeSocketMenu")
    for name, value, low, high in (
        ("Opacity Cut", VISIBLE, 0, 1),
        ("Point Size", 1.0, 0, 100),
        ("Frame Start", 0.0, -1e6, 1e6),
        ("Frame End", 23.0, -1e6, 1e6),
    ):
        socket = new(name, in_out="INPUT", socket_type="NodeSocketFloat")
        socket.default_value, socket.min_value, socket.max_value = value, low, high
    n = _Nodes(tree)
    given = n.add("NodeGroupInput").outputs

    # t = -1..1 over the clip, held at its ends; 0 where the clip is one frame
    frame = n.add("GeometryNodeInputSceneTime").outputs["Frame"]
    start, end = given["Frame Start"], given["Frame End"]
    inside = n.math("MINIMUM", n.math("MAXIMUM", frame, start), end)
    span = n.math("SUBTRACT", end, start)
    twice = n.math("MULTIPLY", n.math("SUBTRACT", inside, start), 2.0)
    time = n.math("DIVIDE", n.math("SUBTRACT", twice, span), n.math("MAXIMUM", span, 1e-6))

    # gs_alpha = gs_opacity · exp(-½ (t - gs_t)² / gs_sigma_t²)
    away = n.math("SUBTRACT", time, n.named("gs_t"))
    lives = n.math("DIVIDE", away, n.named("gs_sigma_t"))
    fade = n.math("EXPONENT", n.math("MULTIPLY", n.math("MULTIPLY", lives, lives), -0.5))
    alpha = n.math("MULTIPLY", n.named("gs_opacity"), fade)
    g = given["Geometry"] if clouds else n.out("GeometryNodeMeshToPoints", given["Geometry"])
    g = n.out("GeometryNodeStoreNamedAttribute", g, None, "gs_alpha", alpha, data_type="FLOAT")
    faint = n.math("LESS_THAN", n.named("gs_alpha"), given["Opacity Cut"])
    g = n.out("GeometryNodeDeleteGeometry", g, faint, domain="POINT")

    # position = own position + gs_velocity · (t - gs_t)
    away = n.math("SUBTRACT", time, n.named("gs_t"))
    step = n.add("ShaderNodeVectorMath", n.named("gs_velocity", "FLOAT_VECTOR"), operation="SCALE")
    n.put(step.inputs["Scale"], away)
    g = n.out("GeometryNodeSetPosition", g, None, None, step.outputs["Vector"])

    size = n.math("MULTIPLY", n.named("gs_radius"), given["Point Size"])
    points = n.out("GeometryNodeSetPointRadius", g, None, size)
    points = n.out("GeometryNodeSetMaterial", points, None, _points_material())
    splats = n.out("GeometryNodeSetPointRadius", g, None, n.named("gs_reach"))
    splats = n.out("GeometryNodeSetMaterial", splats, None, _splats_material())
    viewport = n.add("GeometryNodeIsViewport").outputs[0]
    automatic = n.out("GeometryNodeSwitch", viewport, splats, points, input_type="GEOMETRY")

    choice = n.add("GeometryNodeMenuSwitch", data_type="GEOMETRY")
    for old, look in zip(choice.enum_items, LOOKS, strict=False):  # renamed, not replaced: an item keeps the
        old.name = look  # number that it was born with, and the numbers are to be indices into LOOKS
    for look in LOOKS[len(choice.enum_items) :]:
        choice.enum_items.new(look)
    n.put(choice.inputs[0], given["Look"])
    for look, geometry in zip(LOOKS, (automatic, points, splats), strict=True):
        n.put(choice.inputs[look], geometry)
    n.put(n.add("NodeGroupOutput").inputs[0], choice.outputs[0])
    menu.default_value = LOOKS[0]
    return tree


def _material(name: str):
    """-> (material, its emptied tree or None where it was there already)."""
    if material := bpy.data.materials.get(name):
        return material, None
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    material.node_tree.nodes.clear()
    if hasattr(material, "cycles"):
        material.cycles.emission_sampling = "NONE"  # a million splats are no lamps
    return material, _Nodes(material.node_tree)


def _points_material():
    """Unlit colour: the light is in the pictures that the asset was made from."""
    material, n = _material(f"{GROUP} Points")
    if n:
        color = n.add("ShaderNodeAttribute", attribute_name="gs_color").outputs["Color"]
        n.add("ShaderNodeOutputMaterial", n.out("ShaderNodeEmission", color, 1.0))
    return material


def _splats_material():
    """On the front of a sphere: u = (RS)⁻¹ (hit - centre), w = (RS)⁻¹ view direction; the ray passes the
    centre at the distance |u × w| / |w|, which float32 takes well for flat splats too."""
    material, n = _material(f"{GROUP} Splats")
    if not n:
        return material

    def attribute(name: str, output: str):
        return n.add("ShaderNodeAttribute", attribute_name=name).outputs[output]

    def local(world):  # a difference of places: the object's scale is undone, its location does not matter
        node = n.add("ShaderNodeVectorTransform", world, vector_type="VECTOR")
        node.convert_from, node.convert_to = "WORLD", "OBJECT"
        return node.outputs[0]

    geometry = n.add("ShaderNodeNewGeometry").outputs
    centre = n.add("ShaderNodePointInfo").outputs["Position"]
    offset = local(n.vector("SUBTRACT", geometry["Position"], centre))
    ray = local(geometry["Incoming"])
    rows = [attribute(f"gs_row_{i}", "Vector") for i in range(3)]
    u = n.out("ShaderNodeCombineXYZ", *(n.vector("DOT_PRODUCT", row, offset) for row in rows))
    w = n.out("ShaderNodeCombineXYZ", *(n.vector("DOT_PRODUCT", row, ray) for row in rows))
    cross = n.vector("CROSS_PRODUCT", u, w)
    d2 = n.math("DIVIDE", n.vector("DOT_PRODUCT", cross, cross), n.vector("DOT_PRODUCT", w, w))
    alpha = n.math("MULTIPLY", attribute("gs_alpha", "Fac"), n.math("EXPONENT", n.math("MULTIPLY", d2, -0.5)))
    clear = n.out("ShaderNodeBsdfTransparent")
    glow = n.out("ShaderNodeEmission", attribute("gs_color", "Color"), 1.0)
    n.add("ShaderNodeOutputMaterial", n.out("ShaderNodeMixShader", alpha, clear, glow))
    return material


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
