# SPDX-License-Identifier: GPL-3.0-or-later
"""What a scene holds that a reconstruction comes to grief over, found before anything is rendered: surroundings, what
has no surface, an animation that ends early. Quick enough for draw functions: nothing is evaluated."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from itertools import product

import numpy as np
from mathutils import Vector
from mathutils.bvhtree import BVHTree

MOST_SURVEYED = 500  # objects; of larger scenes nothing is said
MOST_AROUND = 6  # objects that may be surroundings: a ground, a backdrop, walls
DWARFS, DWARFS_FAR = 2.0, 4.0  # how many times larger than all else a flat one is, and one that is not flat
FLAT = 0.02  # of the longest side
FEW_FACES = 2000  # of a dome or backdrop
FREE = 1.5  # half-sizes of all else that lie between it and a dome or backdrop
WALL = 3  # level and upward directions at least in which a dome or backdrop is seen: more than in which a table is
DIRECTIONS = [Vector(d).normalized() for d in product((-1, 0, 1), repeat=3) if any(d)]
WHITE = 1.05  # radiance from which on an 8-bit picture shows nothing but white
MOVING = {"ARMATURE", "CLOTH", "SOFT_BODY", "HOOK", "LATTICE", "MESH_DEFORM", "SURFACE_DEFORM", "CURVE", "NODES"}
TIMED = {"CLOTH", "SOFT_BODY", "FLUID", "OCEAN", "WAVE", "BUILD", "EXPLODE", "MESH_SEQUENCE_CACHE", "DYNAMIC_PAINT",
         "PARTICLE_SYSTEM"}  # fmt: skip


# ---------------------------------------------------------------- surroundings


def surroundings(objects: list) -> list:
    """Of the objects to capture the still ones that dwarf all others and are flat, or leave them much room: a ground, a
    backdrop, a dome. They would set the volume's bounds, and what matters would be a few pixels."""
    if len(objects) > MOST_SURVEYED:
        return []
    corners = {ob: points for ob in objects if len(points := _corners(ob))}
    by_size = sorted(corners, key=lambda ob: -_ball([corners[ob]])[1])
    for count in range(1, min(MOST_AROUND, len(by_size) - 1) + 1):
        centre, radius = _ball([corners[ob] for ob in by_size[count:]])
        big = by_size[:count]
        if radius > 0 and all(_surrounds(ob, _ball([corners[ob]])[1], centre, radius) for ob in big):
            return big
    return []


def within(place, objects: list) -> bool:
    """Whether a place lies in the box around the objects, of which there are not too many to look at."""
    if len(objects) > MOST_SURVEYED or not len(points := np.concatenate([_corners(ob) for ob in objects] or [[]])):
        return False
    return bool((points.min(0) < np.array(place)).all() and (np.array(place) < points.max(0)).all())


def _corners(ob) -> np.ndarray:
    """(N,3) corners of the box around an object, or of those around what it instances, in the world."""
    if ob.instance_type == "COLLECTION" and ob.instance_collection:
        boxes = [(ob.matrix_world @ o.matrix_world, o) for o in ob.instance_collection.all_objects]
    else:
        boxes = [(ob.matrix_world, ob)]
    shapes = [(m, o) for m, o in boxes if o.type not in ("EMPTY", "LIGHT", "CAMERA", "ARMATURE", "SPEAKER", "LATTICE")]
    return np.array([m @ Vector(c) for m, o in shapes for c in o.bound_box]).reshape(-1, 3)


def _ball(boxes: list[np.ndarray]) -> tuple[np.ndarray, float]:
    """Middle and half diagonal of the box around all points."""
    points = np.concatenate(boxes)
    low, high = points.min(0), points.max(0)
    return (low + high) / 2, float(np.linalg.norm(high - low) / 2)


def _surrounds(ob, size: float, centre: np.ndarray, radius: float) -> bool:
    if size < DWARFS * radius or ob.type != "MESH" or ob.particle_systems or not _stands_still(ob):
        return False
    if min(ob.dimensions) <= FLAT * max(ob.dimensions):
        return True
    return size >= DWARFS_FAR * radius and 0 < len(ob.data.polygons) <= FEW_FACES and _has_room(ob, centre, radius)


def _has_room(ob, centre: np.ndarray, radius: float) -> bool:
    """Whether it is seen from the ball around all else beside and above it, far away and nowhere near."""
    places = [ob.matrix_world @ v.co for v in ob.data.vertices]
    tree = BVHTree.FromPolygons(places, [tuple(p.vertices) for p in ob.data.polygons])
    ways = [way for way in DIRECTIONS if way.z > -1e-6]
    hits = [tree.ray_cast(Vector(centre) + radius * way, way)[3] for way in ways]
    far = [h for h in hits if h is not None]
    return len(far) >= WALL and min(far) > FREE * radius


def _stands_still(ob) -> bool:
    above = ob
    while above:
        if above.animation_data or above.rigid_body or above.constraints:
            return False
        above = above.parent
    return not ob.data.shape_keys and not any(m.type in MOVING for m in ob.modifiers)


# ---------------------------------------------------------------- what has no surface


def without_surface(objects: list) -> dict:
    """object -> "a volume" or "glass" of what shows no surface whose depth could be known."""
    found = {}
    for ob in objects if len(objects) <= MOST_SURVEYED else ():
        if ob.type == "VOLUME" or any(m.type == "FLUID" and m.fluid_type == "DOMAIN" for m in ob.modifiers):
            found[ob] = "a volume"
            continue
        kinds = {_kind(slot.material) for slot in ob.material_slots if slot.material}
        if kinds and None not in kinds:
            found[ob] = sorted(kinds)[0]
    return found


def mostly_without_surface(objects: list) -> bool:
    """Whether what has no surface makes up half of it, by size."""
    if not (unseen := without_surface(objects)):
        return False
    sizes = {ob: _ball([points])[1] for ob in objects if len(points := _corners(ob))}
    return 2 * sum(sizes.get(ob, 0) for ob in unseen) >= sum(sizes.values()) > 0


def _kind(material) -> str | None:
    """ "a volume", "glass", or None of a material that has a surface."""
    if not material.use_nodes or not material.node_tree:
        return None
    for node in material.node_tree.nodes:
        if node.type == "OUTPUT_MATERIAL" and node.is_active_output:
            if node.inputs["Volume"].is_linked and not node.inputs["Surface"].is_linked:
                return "a volume"
            links = node.inputs["Surface"].links
            return "glass" if links and _is_clear(links[0].from_node) else None
    return None


def _is_clear(node) -> bool:
    if node.type == "BSDF_PRINCIPLED":
        weight = node.inputs["Transmission Weight"]
        return not weight.is_linked and weight.default_value > 0.5
    return node.type in ("BSDF_GLASS", "BSDF_REFRACTION")


# ---------------------------------------------------------------- hair, and what glows


def hair(objects: list) -> tuple[list, list]:
    """The objects that are hair curves, and those with hair of particle systems that renders show."""
    if len(objects) > MOST_SURVEYED:
        return [], []
    systems = {ob: [m.particle_system for m in ob.modifiers if m.type == "PARTICLE_SYSTEM" and m.show_render]
               for ob in objects}  # fmt: skip
    grown = [ob for ob, found in systems.items() if any(s and s.settings.type == "HAIR" for s in found)]
    return [ob for ob in objects if ob.type == "CURVES"], grown


def brighter_than_white(objects: list) -> list:
    """The objects with a material that glows brighter than a picture can show."""
    if len(objects) > MOST_SURVEYED:
        return []
    return [ob for ob in objects if any(slot.material and _outshines(slot.material) for slot in ob.material_slots)]


def _outshines(material) -> bool:
    for node in material.node_tree.nodes if material.use_nodes and material.node_tree else ():
        if node.type == "EMISSION":
            colour, strength = node.inputs["Color"], node.inputs["Strength"]
            used = node.outputs[0].is_linked
        elif node.type == "BSDF_PRINCIPLED":
            colour, strength = node.inputs["Emission Color"], node.inputs["Emission Strength"]
            used = node.outputs[0].is_linked
        else:
            continue
        if used and (1.0 if colour.is_linked else max(colour.default_value[:3])) * strength.default_value > WHITE:
            return True
    return False


# ---------------------------------------------------------------- where the animation ends


def animation_end(objects: Iterable) -> int | None:
    """The frame of the last key of all objects that are not cameras or lights; None where nothing is keyed, or where
    something may move by itself: physics, drivers, curves that go on, nodes that know the time."""
    last = None
    for ob in objects:
        if ob.type in ("CAMERA", "LIGHT") or ob.get("timesplat"):
            continue
        if ob.rigid_body or ob.particle_systems or (ob.type == "VOLUME" and ob.data.is_sequence):
            return None
        if any(m.type in TIMED or (m.type == "NODES" and _knows_time(m.node_group)) for m in ob.modifiers):
            return None
        for animation in _animations(ob):
            end = _last_key(animation)
            if end == math.inf:
                return None
            last = end if last is None else max(last, end)
    return None if last in (None, -math.inf) else math.ceil(last)


def _animations(ob) -> Iterator:
    materials = [slot.material for slot in ob.material_slots if slot.material]
    for block in (ob, ob.data, getattr(ob.data, "shape_keys", None), *materials, *(m.node_tree for m in materials)):
        if block and block.animation_data:
            yield block.animation_data


def _last_key(animation) -> float:
    """inf where it goes on after it, -inf where there is none."""
    if len(animation.drivers):
        return math.inf
    strips = [s for track in animation.nla_tracks if not track.mute for s in track.strips if not s.mute]
    ends = [s.frame_end for s in strips]
    curves = _curves(animation.action) if animation.action else []
    if any(len(c.modifiers) or c.extrapolation == "LINEAR" for c in curves):
        return math.inf
    return max([*ends, *(c.range()[1] for c in curves)], default=-math.inf)


def _curves(action) -> list:
    if not hasattr(action, "layers"):  # before Blender 4.4
        return list(action.fcurves)
    bags = [bag for layer in action.layers for strip in layer.strips for bag in strip.channelbags]
    return [curve for bag in bags for curve in bag.fcurves]


def _knows_time(tree, depth: int = 0) -> bool:
    kinds = ("GeometryNodeInputSceneTime", "GeometryNodeSimulationInput")
    return bool(tree) and any(
        node.bl_idname in kinds or (node.type == "GROUP" and depth < 8 and _knows_time(node.node_tree, depth + 1))
        for node in tree.nodes
    )
