# SPDX-License-Identifier: GPL-3.0-or-later
"""Two scenes that the tables of tracks need beside assets: a chequered cloth that falls over a ball, and a ring that
turns and sways, scattered with cones by Geometry Nodes.

    python benchmarks/track_scenes.py FOLDER        # writes cloth.blend and scatter.blend
"""

from __future__ import annotations

import argparse
from pathlib import Path

FRAMES = 24


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="where to write the two .blend files")
    folder = parser.parse_args().folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    import bpy

    for name, build in (("cloth", _cloth), ("scatter", _scatter)):
        bpy.ops.wm.read_factory_settings(use_empty=True)
        bpy.context.scene.frame_start, bpy.context.scene.frame_end = 1, FRAMES
        build(bpy)
        bpy.ops.wm.save_as_mainfile(filepath=str(folder / f"{name}.blend"))
        print(folder / f"{name}.blend")


def _material(bpy, name: str, colours, scale: float = 0.0):
    """Of one colour, or a chequered one of two."""
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    tree = material.node_tree
    surface = next(n for n in tree.nodes if n.type == "BSDF_PRINCIPLED")
    surface.inputs["Roughness"].default_value = 0.9
    if not scale:
        surface.inputs["Base Color"].default_value = (*colours[0], 1)
        return material
    chequer, place = tree.nodes.new("ShaderNodeTexChecker"), tree.nodes.new("ShaderNodeTexCoord")
    chequer.inputs["Scale"].default_value = scale
    for i, colour in enumerate(colours):
        chequer.inputs[f"Color{i + 1}"].default_value = (*colour, 1)
    tree.links.new(place.outputs["UV"], chequer.inputs["Vector"])
    tree.links.new(chequer.outputs["Color"], surface.inputs["Base Color"])
    return material


def _cloth(bpy) -> None:
    bpy.ops.mesh.primitive_grid_add(x_subdivisions=60, y_subdivisions=60, size=2.4, location=(0.15, 0, 0.72))
    cloth = bpy.context.object
    cloth.data.materials.append(_material(bpy, "cloth", ((0.7, 0.05, 0.04), (0.9, 0.8, 0.5)), 14))
    cloth.modifiers.new("Cloth", "CLOTH").settings.quality = 8
    cloth.modifiers["Cloth"].collision_settings.distance_min = 0.02
    bpy.ops.object.shade_smooth()
    bpy.ops.mesh.primitive_uv_sphere_add(radius=0.6, segments=48, ring_count=24)
    ball = bpy.context.object
    ball.data.materials.append(_material(bpy, "ball", ((0.05, 0.25, 0.6),)))
    ball.modifiers.new("Collision", "COLLISION")
    bpy.ops.object.shade_smooth()


def _scatter(bpy) -> None:
    bpy.ops.mesh.primitive_cone_add(vertices=12, radius1=0.06, depth=0.28)
    cone = bpy.context.object
    cone.data.materials.append(_material(bpy, "cone", ((0.9, 0.5, 0.05),)))
    cone.hide_render = cone.hide_viewport = True
    bpy.ops.mesh.primitive_torus_add(major_radius=1, minor_radius=0.32, major_segments=64, minor_segments=24)
    ring = bpy.context.object
    ring.data.materials.append(_material(bpy, "ring", ((0.05, 0.3, 0.15), (0.5, 0.7, 0.3)), 16))
    bend = ring.modifiers.new("Bend", "SIMPLE_DEFORM")
    bend.deform_method, bend.deform_axis = "TWIST", "X"
    for frame, angle, turn in ((1, -0.5, 0), (12, 0.6, 0.6), (24, -0.4, 1.2)):
        bend.angle, ring.rotation_euler = angle, (0.3, 0, turn)
        bend.keyframe_insert("angle", frame=frame)
        ring.keyframe_insert("rotation_euler", frame=frame)
    tree = bpy.data.node_groups.new("Scatter", "GeometryNodeTree")
    tree.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    new, link = tree.nodes.new, tree.links.new
    given, out, join = new("NodeGroupInput"), new("NodeGroupOutput"), new("GeometryNodeJoinGeometry")
    points, instance, shape = (
        new("GeometryNodeMeshToPoints"),  # a point a vertex, so that each has the same mesh under it all the time
        new("GeometryNodeInstanceOnPoints"),
        new("GeometryNodeObjectInfo"),
    )
    some, normal, upright = (
        new("FunctionNodeRandomValue"),
        new("GeometryNodeInputNormal"),
        new("FunctionNodeAlignRotationToVector"),
    )
    some.data_type = "BOOLEAN"
    some.inputs["Probability"].default_value = 0.15
    upright.axis = "Z"
    keep = new("GeometryNodeStoreNamedAttribute")  # what turns: an input of the points that their mesh knows
    keep.data_type, keep.domain = "QUATERNION", "POINT"
    keep.inputs["Name"].default_value = "upright"
    turn = new("GeometryNodeInputNamedAttribute")
    turn.data_type = "QUATERNION"
    turn.inputs["Name"].default_value = "upright"
    shape.inputs["Object"].default_value = cone
    link(normal.outputs[0], upright.inputs["Vector"])
    link(given.outputs[0], keep.inputs["Geometry"])
    link(upright.outputs[0], keep.inputs["Value"])
    link(keep.outputs["Geometry"], points.inputs["Mesh"])
    link(some.outputs[3], points.inputs["Selection"])
    link(points.outputs["Points"], instance.inputs["Points"])
    link(turn.outputs["Attribute"], instance.inputs["Rotation"])
    link(shape.outputs["Geometry"], instance.inputs["Instance"])
    link(given.outputs[0], join.inputs[0])
    link(instance.outputs["Instances"], join.inputs[0])
    link(join.outputs[0], out.inputs[0])
    ring.modifiers.new("Scatter", "NODES").node_group = tree


if __name__ == "__main__":
    main()
