# SPDX-License-Identifier: GPL-3.0-or-later
"""The look Ellipsoids: each Gaussian as a solid of eight vertices along its own axes, all in one mesh.

The solid is a double pyramid over a hexagon, which lies across the two longer axes: a flat Gaussian shows its face, and
a round one is round enough. Its radius is Point Size standard deviations where the Gaussian is opaque, and shrinks to
nothing where it fades to FAINTEST: what is faint hides nothing. Its colour is the mesh's active one, which the shading
Solid shows where it is set to Attribute. No node makes a colour the active one, so that the solid is a mesh of the
file, to which the nodes refer. Attributes of the data:
    gs_size                                        σ along the axes, the longer two first, the shortest last
    gs_facing                                      rotation of these axes, IN the moving frame where there is one
"""

from __future__ import annotations

import bpy
import numpy as np

from ...model.io.asset import VISIBLE
from ...model.io.paths import multiply
from .node_trees import Nodes

SOLID = "Timesplat Ellipsoid"  # the object, its mesh
FAINTEST = VISIBLE  # opacity at which a solid has shrunk to nothing
TO_LAST = np.sqrt(0.5) * np.array([[1, 0, 1, 0], [1, -1, 0, 0], [np.sqrt(2), 0, 0, 0]])  # wxyz: z becomes axis 0, 1, 2
ORDER = np.array([[2, 1, 0], [0, 2, 1], [0, 1, 2]])  # of the σ then
LEFT_BEHIND = (  # attributes that would be copied to each vertex for nothing
    *("gs_alpha", "gs_size", "gs_facing", "gs_velocity", "gs_t", "gs_sigma_t", "gs_opacity", "gs_scale", "gs_rotation"),
    *("gs_order", "gs_radius", "gs_reach", "gs_row_0", "gs_row_1", "gs_row_2"),
)
LEFT_BEHIND_TRACKED = ("gs_turn", "gs_offset", "gs_path_first", "gs_path_knots", "gs_path_start", "gs_path_end")


def ellipsoid_attributes(scale: np.ndarray, rotation: np.ndarray) -> list[tuple]:
    """(name, kind, values) of what the look needs; (N,3) σ and (N,4) wxyz rotation of the axes."""
    shortest = scale.argmin(1)
    return [
        ("gs_size", "FLOAT_VECTOR", np.take_along_axis(scale, ORDER[shortest], 1)),
        ("gs_facing", "QUATERNION", multiply(rotation, TO_LAST[shortest].astype(np.float32))),
    ]


def ellipsoids(n: Nodes, g, size, material, tracked: bool):
    """The points `g` as solids of this material. size: Point Size; tracked: their axes are turned by gs_turn."""
    alpha = n.math("MAXIMUM", n.named("gs_alpha"), 1e-6)
    share = n.math("SQRT", n.math("MAXIMUM", n.math("SUBTRACT", 1.0, n.math("LOGARITHM", alpha, FAINTEST)), 0.0))
    axes = n.add("ShaderNodeVectorMath", n.named("gs_size", "FLOAT_VECTOR"), operation="SCALE")
    n.put(axes.inputs["Scale"], n.math("MULTIPLY", size, share))
    facing = n.named("gs_facing", "QUATERNION")
    if tracked:
        facing = n.out("FunctionNodeRotateRotation", facing, n.named("gs_turn", "QUATERNION"))
    each = n.add("GeometryNodeInstanceOnPoints")
    solid = n.add("GeometryNodeObjectInfo", _solid(material)).outputs["Geometry"]
    found = {"Points": g, "Instance": solid, "Rotation": facing, "Scale": axes.outputs["Vector"]}
    for name, value in found.items():
        n.put(each.inputs[name], value)
    g = each.outputs[0]
    for name in LEFT_BEHIND + (LEFT_BEHIND_TRACKED if tracked else ()):
        node = n.add("GeometryNodeRemoveAttribute", g)
        node.inputs["Name"].default_value = name
        g = node.outputs[0]
    return n.out("GeometryNodeRealizeInstances", g)


def _solid(material):
    """The object with the solid, in no collection: made once a file."""
    if ob := bpy.data.objects.get(SOLID):
        return ob
    around = np.arange(6) * np.pi / 3
    ring = np.stack([np.cos(around), np.sin(around), np.zeros(6)], 1)
    up = [(i, (i + 1) % 6, 6) for i in range(6)]
    mesh = bpy.data.meshes.new(SOLID)
    mesh.from_pydata([*ring.tolist(), (0, 0, 1), (0, 0, -1)], [], [*up, *((b, a, 7) for a, b, _ in up)])
    mesh.attributes.active_color_name = "gs_color"  # which it has not: that of its instance is taken
    mesh.materials.append(material)
    ob = bpy.data.objects.new(SOLID, mesh)
    ob.hide_viewport = ob.hide_render = ob.hide_select = True  # File > Append puts it into the scene
    ob["timesplat"] = 1  # captures leave it out
    return ob
