# SPDX-License-Identifier: GPL-3.0-or-later
"""Surface tracks against Blender's evaluated meshes, read by hand."""

import math

import bpy
import numpy as np
from mathutils import Vector
from mathutils.bvhtree import BVHTree

from timesplat.datagen.sequence import Normalisation
from timesplat.datagen.tracks import track_surfaces

from .helpers import key

NORM = Normalisation(1.7, (0.2, -0.1, 0.3))
FRAMES = [1, 2.25, 3, 4.5]
PIXEL = 0.02


def track(frames=FRAMES, count=300, **options):
    return track_surfaces(frames, NORM, PIXEL, count, **options)


def read_by_hand(frame, names=None):
    """World vertices (V,3) and triangles (T,3) of all meshes that the scene shows, joined."""
    whole = math.floor(frame)
    bpy.context.scene.frame_set(whole, subframe=frame - whole)
    vertices, triangles, count = [], [], 0
    for instance in bpy.context.evaluated_depsgraph_get().object_instances:
        ob = instance.object
        if ob.type != "MESH" or not instance.show_self or (names and ob.name not in names):
            continue
        matrix = instance.matrix_world.copy()
        vertices += [matrix @ v.co for v in ob.data.vertices]
        triangles += [[count + i for i in t.vertices] for t in ob.data.loop_triangles]
        count = len(vertices)
    return np.array(vertices), np.array(triangles)


def weights_in(triangle, point):
    """(3,) barycentric coordinates of a point in a triangle (3,3)."""
    return np.linalg.lstsq(np.vstack([triangle.T, np.ones(3)]), np.append(point, 1), rcond=None)[0]


def matrices(q):
    w, x, y, z = np.moveaxis(np.asarray(q, float), -1, 0)
    rows = [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]]
    rows += [[2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]]
    rows += [[2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def assert_rides(tracks, frames, names=None, at_least=300):
    """Each point stays at one place of one triangle of the meshes, and z of its frame is this triangle's normal."""
    assert len(tracks) >= at_least
    world = tracks.position.astype(float) * NORM.scale + NORM.translation
    shapes = [read_by_hand(frame, names) for frame in frames]
    triangles = shapes[0][1]
    tree = BVHTree.FromPolygons([Vector(v) for v in shapes[0][0]], triangles.tolist())
    z = matrices(tracks.rotation)[..., 2]
    assert np.allclose(np.linalg.norm(tracks.rotation.astype(float), axis=-1), 1, atol=2e-3)
    assert ((tracks.rotation[:, 1:].astype(float) * tracks.rotation[:, :-1]).sum(-1) >= 0).all()
    facing = []
    for point, normal in zip(world, z, strict=True):
        _, _, index, distance = tree.find_nearest(Vector(point[0]))
        assert distance < 1e-4
        corner = triangles[index]
        w = weights_in(shapes[0][0][corner], point[0])
        moved = np.array([w @ vertices[corner] for vertices, _ in shapes])
        assert np.abs(moved - point).max() < 2e-4
        a, b, c = np.stack([vertices[corner] for vertices, _ in shapes], 1)
        n = np.cross(b - a, c - a)
        n /= np.linalg.norm(n, axis=1, keepdims=True)
        facing.append((n * normal).sum(1))
    assert (np.array(facing) > 0.999).all(1).mean() > 0.97  # but for points on an edge, that found its other triangle


def bent_by_bones():
    bpy.ops.mesh.primitive_cylinder_add(vertices=12, radius=0.3, depth=2)
    ob = bpy.context.object
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.subdivide(number_cuts=3)
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.ops.object.armature_add(location=(0, 0, -1))
    rig = bpy.context.object
    bpy.ops.object.mode_set(mode="EDIT")
    bones = rig.data.edit_bones
    bones[0].tail = (0, 0, 1)
    tip = bones.new("tip")
    tip.head, tip.tail, tip.parent = (0, 0, 1), (0, 0, 2), bones[0]
    bpy.ops.object.mode_set(mode="OBJECT")
    for name, part in (("Bone", lambda z: max(0, 0.5 - z)), ("tip", lambda z: max(0, 0.5 + z))):
        group = ob.vertex_groups.new(name=name)
        for v in ob.data.vertices:
            group.add([v.index], part(v.co.z), "REPLACE")
    ob.modifiers.new("skin", "ARMATURE").object = rig
    bone = rig.pose.bones["tip"]
    bone.rotation_mode = "XYZ"
    key(bone, "rotation_euler", {1: (0, 0, 0), 5: (1.2, 0.4, 0)})
    key(rig, "location", {1: (0, 0, -1), 5: (0.5, 0, -1)})
    return ob


def geometry_nodes(ob, build):
    """A modifier of nodes that `build(nodes, connect)` adds, from "in" to "out"."""
    group = bpy.data.node_groups.new("nodes", "GeometryNodeTree")
    for way in ("INPUT", "OUTPUT"):
        group.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    nodes = {"in": group.nodes.new("NodeGroupInput"), "out": group.nodes.new("NodeGroupOutput")}

    def add(kind):
        return group.nodes.new(kind)

    build(add, group.links.new, nodes["in"].outputs[0], nodes["out"].inputs[0])
    ob.modifiers.new("nodes", "NODES").node_group = group


def building_up(ob):
    m = ob.modifiers.new("m", "BUILD")
    m.frame_start, m.frame_duration = 1, 10
