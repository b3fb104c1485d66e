# SPDX-License-Identifier: GPL-3.0-or-later
"""The node group that plays an asset, and the materials of its looks; its inputs are the sliders (sliders.py).

All of it is saved in the .blend: it plays without this add-on, at fractional frames too. At scene frame f

    s     = (f - Frame Start - Time Offset) · Time Scale           frames since the clip's start
    s     held at 0 and the clip's length L (Hold), taken modulo L + 1 (Loop: every frame once a round), or run
          to and fro between 0 and L (Ping-Pong)
    t     = 2 s / L - 1
    alpha = gs_opacity · exp(-½ (t - gs_t)² / (gs_sigma_t · Lifetime Scale)²)
    place = own position + gs_velocity · (t - gs_t)

or where Gaussians ride on paths (see tracks.py), of which t lies at the share `part` of the way between two knots,

    alpha = gs_opacity, and it is left out where t is not within gs_path_start..gs_path_end
    turn  = the two knots' gs_turn, mixed by part and normalised       stored as gs_turn
    place = the two knots' places, mixed by part, + gs_offset turned by it; so are gs_row_0..2 and rotation

A Gaussian is left out where alpha < Opacity Cut, where gs_order >= Density (gs_order is a random order of the
Gaussians in 0..1, so that a lower density shows a part of what a higher one does), and, with Crop, where its
OWN position (the one at gs_t, in normalised space) is outside Crop Min..Crop Max: it is in or out for all time,
which is what an export can say too.
"""

from __future__ import annotations

import bpy
import numpy as np

from ...model.io.asset import SH_C0
from ...model.io.paths import WINDOW_SLACK
from .ellipsoids import ellipsoids
from .node_trees import Nodes
from .sliders import NATIVE, REPEATS, SLIDERS

GROUP = "Timesplat 3"  # the number counts versions of the node group, so that old files keep theirs
NATIVE_NAMES = ("3D Gaussian Splats", "GAUSSIAN_SPLAT")  # of the type: what the menu shows, its identifier


# ---------------------------------------------------------------- the group


def node_group(clouds: bool, tracked: bool = False):
    """The shared node group: made once a file. clouds: for point clouds, else for meshes of vertices. tracked: for
    Gaussians that ride on paths."""
    name = GROUP + (" Tracked" if tracked else "") + ("" if clouds else " Mesh") + (" Native" if NATIVE else "")
    if tree := bpy.data.node_groups.get(name):
        return tree
    tree = bpy.data.node_groups.new(name, "GeometryNodeTree")
    tree.is_modifier = True
    menus = _make_interface(tree.interface, tracked)
    n = Nodes(tree)
    given = n.add("NodeGroupInput").outputs
    geometry = given["Geometry"] if clouds else n.out("GeometryNodeMeshToPoints", given["Geometry"])
    shown = _ride_paths(n, given, geometry) if tracked else _follow_lines(n, given, geometry)
    n.put(n.add("NodeGroupOutput").inputs[0], _choose_look(n, given, shown, tracked))
    for name, socket in menus.items():  # a menu has items only once it is connected
        socket.default_value = SLIDERS[name].default
    return tree


def _make_interface(interface, tracked: bool) -> dict:
    """Makes the inputs and the output; returns the menus by name. On paths there is no lifetime to scale."""
    interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    panels = {"": None} | {name: interface.new_panel(name) for name in ("Time", "Crop")}
    menus = {}
    for name, slider in SLIDERS.items():
        if tracked and name == "Lifetime Scale":
            continue
        socket = interface.new_socket(
            name,
            in_out="INPUT",
            socket_type=f"NodeSocket{slider.socket}",
            description=slider.description,
            parent=panels[slider.panel],
        )
        if slider.socket == "Menu":
            menus[name] = socket
            continue
        socket.default_value = slider.default
        if slider.lowest is not None:
            socket.min_value, socket.max_value = slider.lowest, slider.highest
    if tracked:
        what = "The object with the paths that the Gaussians ride on"
        interface.new_socket("Paths", in_out="INPUT", socket_type="NodeSocketObject", description=what)
    return menus


def _model_time(n: Nodes, given):
    """The time -1..1 that is shown at the scene's frame."""
    frame = n.add("GeometryNodeInputSceneTime").outputs["Frame"]
    start = given["Frame Start"]
    length = n.math("MAXIMUM", n.math("SUBTRACT", given["Frame End"], start), 0.0)
    since = n.math("SUBTRACT", n.math("SUBTRACT", frame, start), given["Time Offset"])
    since = n.math("MULTIPLY", since, given["Time Scale"])
    hold = n.math("MINIMUM", n.math("MAXIMUM", since, 0.0), length)
    loop = n.math("MINIMUM", n.math("FLOORED_MODULO", since, n.math("ADD", length, 1.0)), length)
    ways = (hold, loop, n.math("PINGPONG", since, length))
    inside = n.menu(given["Repeat"], dict(zip(REPEATS, ways, strict=True)), "FLOAT")
    twice = n.math("SUBTRACT", n.math("MULTIPLY", inside, 2.0), length)
    return n.math("DIVIDE", twice, n.math("MAXIMUM", length, 1e-6))  # 0 where the clip is one frame


def _leave_out(n: Nodes, given, g, alpha, *unseen):
    """Stores alpha; leaves out what the sliders say, and where any of `unseen` is true."""
    g = n.out("GeometryNodeStoreNamedAttribute", g, None, "gs_alpha", alpha, data_type="FLOAT")
    place = n.out("GeometryNodeInputPosition")
    above, below = n.vector("SUBTRACT", place, given["Crop Min"]), n.vector("SUBTRACT", given["Crop Max"], place)
    inner = n.add("ShaderNodeSeparateXYZ", n.vector("MINIMUM", above, below)).outputs
    depth = n.math("MINIMUM", n.math("MINIMUM", inner[0], inner[1]), inner[2])
    outside = n.out("FunctionNodeBooleanMath", given["Crop"], n.math("LESS_THAN", depth, 0.0), operation="AND")
    faint = n.math("LESS_THAN", n.named("gs_alpha"), given["Opacity Cut"])
    spare = n.math("SUBTRACT", 1.0, n.math("LESS_THAN", n.named("gs_order"), given["Density"]))
    return n.out("GeometryNodeDeleteGeometry", g, n.either(faint, outside, spare, *unseen), domain="POINT")


def _follow_lines(n: Nodes, given, g):
    """The Gaussians that are shown at the scene's frame, where they are, with their alpha."""
    time = _model_time(n, given)
    away = n.math("SUBTRACT", time, n.named("gs_t"))
    lives = n.math("DIVIDE", away, n.math("MULTIPLY", n.named("gs_sigma_t"), given["Lifetime Scale"]))
    fade = n.math("EXPONENT", n.math("MULTIPLY", n.math("MULTIPLY", lives, lives), -0.5))
    alpha = n.math("MULTIPLY", n.named("gs_opacity"), fade)
    g = _leave_out(n, given, g, alpha)

    away = n.math("SUBTRACT", time, n.named("gs_t"))
    step = n.add("ShaderNodeVectorMath", n.named("gs_velocity", "FLOAT_VECTOR"), operation="SCALE")
    n.put(step.inputs["Scale"], away)
    return n.out("GeometryNodeSetPosition", g, None, None, step.outputs["Vector"])


def _ride_paths(n: Nodes, given, g):
    """As `_follow_lines`, with gs_turn, where they ride on paths."""
    time, start, end = _model_time(n, given), n.named("gs_path_start"), n.named("gs_path_end")
    early = n.math("LESS_THAN", time, n.math("SUBTRACT", start, WINDOW_SLACK))
    late = n.math("GREATER_THAN", time, n.math("ADD", end, WINDOW_SLACK))
    g = _leave_out(n, given, g, n.named("gs_opacity"), early, late)

    last = n.math("SUBTRACT", n.named("gs_path_knots", "INT"), 1.0)
    share = n.math("DIVIDE", n.math("SUBTRACT", time, start), n.math("SUBTRACT", end, start))
    along = n.math("MULTIPLY", n.math("MINIMUM", n.math("MAXIMUM", share, 0.0), 1.0), last)
    whole = n.math("MINIMUM", n.math("FLOOR", along), n.math("MAXIMUM", n.math("SUBTRACT", last, 1.0), 0.0))
    part = n.math("SUBTRACT", along, whole)
    first, onward = n.named("gs_path_first", "INT"), n.math("MINIMUM", n.math("ADD", whole, 1.0), last)
    pair = n.math("ADD", first, whole), n.math("ADD", first, onward)

    knots = n.add("GeometryNodeObjectInfo", given["Paths"]).outputs["Geometry"]

    def at_both(value, kind: str) -> list:
        return [n.out("GeometryNodeSampleIndex", knots, value, index, data_type=kind) for index in pair]

    turns = at_both(n.named("gs_turn", "QUATERNION"), "QUATERNION")
    wxyz = (n.add("FunctionNodeRotationToQuaternion", turn).outputs for turn in turns)
    mixed = [n.out("ShaderNodeMix", part, a, b, data_type="FLOAT") for a, b in zip(*wxyz, strict=True)]
    turn = n.out("FunctionNodeQuaternionToRotation", *mixed)  # normalises; Mix Rotation would turn another way
    g = n.out("GeometryNodeStoreNamedAttribute", g, None, "gs_turn", turn, data_type="QUATERNION")
    places = at_both(n.out("GeometryNodeInputPosition"), "FLOAT_VECTOR")
    place = n.out("ShaderNodeMix", part, *places, data_type="VECTOR")
    offset = n.out("FunctionNodeRotateVector", n.named("gs_offset", "FLOAT_VECTOR"), n.named("gs_turn", "QUATERNION"))
    return n.out("GeometryNodeSetPosition", g, None, n.vector("ADD", place, offset))


def _turn(n: Nodes, g, name: str, kind: str):
    """An attribute, FLOAT_VECTOR or QUATERNION, turned from the moving frame by gs_turn."""
    node = "FunctionNodeRotateVector" if kind == "FLOAT_VECTOR" else "FunctionNodeRotateRotation"
    turned = n.out(node, n.named(name, kind), n.named("gs_turn", "QUATERNION"))
    return n.out("GeometryNodeStoreNamedAttribute", g, None, name, turned, data_type=kind)


def _choose_look(n: Nodes, given, g, tracked: bool):
    """The Gaussians as the slider Look has them. What only some looks need is not evaluated for the others."""
    solids = ellipsoids(n, g, given["Point Size"], points_material(), tracked)
    size = n.math("MULTIPLY", n.named("gs_radius"), given["Point Size"])
    points = n.out("GeometryNodeSetPointRadius", g, None, size)
    points = n.out("GeometryNodeSetMaterial", points, None, points_material())
    splats = g
    for name in ("gs_row_0", "gs_row_1", "gs_row_2") if tracked else ():
        splats = _turn(n, splats, name, "FLOAT_VECTOR")
    splats = n.out("GeometryNodeSetPointRadius", splats, None, n.named("gs_reach"))
    splats = n.out("GeometryNodeSetMaterial", splats, None, splats_material())
    viewport = n.add("GeometryNodeIsViewport").outputs[0]
    automatic = n.out("GeometryNodeSwitch", viewport, splats, solids, input_type="GEOMETRY")
    options = {"Automatic": automatic, "Points": points, "Splats": splats, "Ellipsoids": solids}
    if NATIVE:
        options["Native"] = native_splats(n, _turn(n, g, "rotation", "QUATERNION") if tracked else g)
    return n.menu(given["Look"], options, "GEOMETRY")


def native_splats(n: Nodes, g):
    """Splats of Blender's own kind: the opacity of radiance:base follows the moment. No material: Blender's own
    for splats is used. The type is set where Blender has it."""
    base = n.add("FunctionNodeSeparateColor", n.named("radiance:base", "FLOAT_COLOR")).outputs
    color = n.out("FunctionNodeCombineColor", base[0], base[1], base[2], n.named("gs_alpha"))
    g = n.out("GeometryNodeStoreNamedAttribute", g, None, "radiance:base", color, data_type="FLOAT_COLOR")
    g = n.out("GeometryNodeSetMaterial", g)
    if not NATIVE:
        return g
    node = n.add("GeometryNodePointsSetType", g)
    for name in NATIVE_NAMES:
        try:
            node.inputs["Type"].default_value = name
            break
        except TypeError:  # this version calls it by the other name
            continue
    return node.outputs[0]


def native_attributes(asset) -> list[tuple]:
    """What `native_splats` needs in the data, beside the rest: (name, kind, values) each."""
    base = (asset.rgb - 0.5) / SH_C0
    alpha = asset.opacity[:, None]
    return [
        ("scale", "FLOAT_VECTOR", asset.soft_scale()),
        ("rotation", "QUATERNION", asset.rotation),
        ("radiance:base", "FLOAT4", np.concatenate([base, alpha], 1)),
    ]


# ---------------------------------------------------------------- materials


def _material(name: str):
    """-> (material, its emptied tree or None where it was there already)."""
    if material := bpy.data.materials.get(name):
        return material, None
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    material.node_tree.nodes.clear()
    if hasattr(material, "cycles"):
        material.cycles.emission_sampling = "NONE"  # a million splats are no lamps
    return material, Nodes(material.node_tree)


def points_material():
    """Unlit colour: the light is in the pictures that the asset was made from."""
    material, n = _material(f"{GROUP} Points")
    if n:
        color = n.add("ShaderNodeAttribute", attribute_name="gs_color").outputs["Color"]
        n.add("ShaderNodeOutputMaterial", n.out("ShaderNodeEmission", color, 1.0))
    return material


def splats_material():
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
    # Cycles built without Embree meets the back of the sphere too: it is left out
    alpha = n.math("MULTIPLY", alpha, n.math("GREATER_THAN", n.vector("DOT_PRODUCT", offset, ray), 0.0))
    clear = n.out("ShaderNodeBsdfTransparent")
    glow = n.out("ShaderNodeEmission", attribute("gs_color", "Color"), 1.0)
    n.add("ShaderNodeOutputMaterial", n.out("ShaderNodeMixShader", alpha, clear, glow))
    return material
