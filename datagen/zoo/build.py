# SPDX-License-Identifier: GPL-3.0-or-later
"""Builds a procedural object in Blender: its mesh, its motion and its materials.

`build_object(seed)` puts one object into the current, empty scene, moving over frames 1 to 24 at 24 fps. Any
non-negative integer is a seed, and the same seed gives the same object in every process. By convention
seeds below `FIRST_EVALUATION_SEED` are for training; evaluation and demonstrations start there.

The whole object is one mesh whose vertex positions are baked into absolute shape keys, one a frame. So
topology never changes, motion vectors are right for limbs, morphs and turning wheels alike, and what is
seen at a frame does not depend on drivers, modifiers or constraints. Patterns are shader nodes in the
rest pose's coordinates, the vertex attribute "rest", so that they stick to the surface.
"""

from __future__ import annotations

import bpy
import numpy as np

from .floaters import flyer, monster, swimmer
from .puppet import FRAMES, TAU, Paint, Part, Puppet
from .shapes import apply, rotation, translation
from .things import machine, morph, plant, stack, vehicle
from .trials import STEPS, TRIALS, VERSION
from .walkers import humanoid, walker

FIRST_EVALUATION_SEED = 1_000_000
# A change to any family that draws other numbers changes what every seed shows.
FRAMES_PER_SECOND = 24
# How often each family is drawn: characters and animals dominate what people animate.
FAMILY_WEIGHTS = {
    walker: 0.24,
    humanoid: 0.2,
    swimmer: 0.13,
    flyer: 0.12,
    vehicle: 0.08,
    machine: 0.04,
    morph: 0.03,
    stack: 0.05,
    plant: 0.04,
    monster: 0.07,
}


def build_object(seed: int) -> dict:
    """Build the object of this seed into the current scene, which should be empty.

    Sets the scene's frame range, rate and current frame. Returns what it is, for provenance: seed,
    family, motions, the parts' names with their number, vertices, frames, and whether it is still."""
    puppet, family = _design(seed)
    parts = puppet.finish()
    _add_mesh(f"zoo_{seed}", parts, puppet.paints)
    _set_frames(FRAMES)
    names = [part.name for part in parts]
    return {
        "generator": "timesplat.datagen.zoo",  # a name that data sets bear, whatever this file is called
        "seed": int(seed),
        "family": family,
        "motions": puppet.motions,
        "parts": {name: names.count(name) for name in dict.fromkeys(names)},
        "vertices": sum(len(part.rest) for part in parts),
        "frames": [1, FRAMES],
        "static": puppet.still,
    }


def build_trial(name: str, level: float) -> dict:
    """Build a trial of `TRIALS` at a level into the current scene, which should be empty, from frame 1 on, a step a
    frame. Returns what it is, for provenance."""
    trial = TRIALS[name](level)
    _add_mesh(f"trial_{name}", trial.parts, trial.paints)
    _set_frames(STEPS)
    return {"trial": name, "level": level, "version": VERSION}


def _set_frames(count: int) -> None:
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = 1, count
    scene.render.fps, scene.render.fps_base = FRAMES_PER_SECOND, 1.0
    scene.frame_set(1)


def _design(seed: int) -> tuple[Puppet, str]:
    """Everything that is random about an object, before Blender sees it."""
    rng = np.random.default_rng(seed)
    families = list(FAMILY_WEIGHTS)
    weights = np.array(list(FAMILY_WEIGHTS.values()))
    family = families[rng.choice(len(families), p=weights / weights.sum())]
    puppet = Puppet(rng)
    family(puppet)
    _roam(puppet, rooted=family in (machine, plant))
    return puppet, family.__name__


def _roam(p: Puppet, rooted: bool):
    """Move the whole body: most stay in place, some travel, turn, hop or tumble; some look elsewhere."""
    low, high = p.bounds()
    size, t = float((high - low).max()), p.t
    heading = rotation((0, 0, 1), p.u(0, TAU) if p.chance(0.35) else 0.0)
    move = str(p.rng.choice(["stay", "travel", "turn", "hop", "tumble"], p=[0.5, 0.24, 0.12, 0.1, 0.04]))
    if rooted and move != "turn":
        move = "stay"
    stride, bend, height = p.u(0.2, 1.0) * size, p.u(-0.8, 0.8), p.u(0.1, 0.35) * size
    axis = p.rng.normal(size=3)
    if move == "stay" or p.still:
        motion = translation(np.zeros((FRAMES, 3)))
    elif move == "travel":
        # Along a gentle curve, always facing forward (-Y).
        angle = bend * t
        step = np.stack([np.sin(angle), -np.cos(angle), 0 * t], -1) * stride / FRAMES
        motion = translation(np.cumsum(step, 0)) @ rotation((0, 0, 1), angle)
    elif move == "turn":
        motion = rotation((0, 0, 1), p.turn(bend))
    elif move == "hop":
        motion = translation(np.abs(np.sin(np.pi * p.tempo * t))[:, None] * (0, 0, height))
    else:
        motion = rotation(axis, p.turn(bend * 0.7))
    if move != "stay" and not p.still:
        p.motions.append(move)
    centre = translation((low + high) / 2)
    p.warps.append(lambda points: apply(heading @ centre @ motion @ np.linalg.inv(centre), points))


def _add_mesh(name: str, parts: list[Part], paints: dict[str, Paint]):
    """One mesh object with a shape key a frame, played by its evaluation time."""
    starts = np.cumsum([0] + [len(part.rest) for part in parts])
    rest = np.concatenate([part.rest for part in parts])
    frames = np.concatenate([part.posed for part in parts], 1).astype(np.float32)
    faces = [[v + start for v in face] for part, start in zip(parts, starts, strict=False) for face in part.faces]
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(frames[0], [], faces)
    used = list(dict.fromkeys(part.paint for part in parts))
    low, high = rest.min(0), rest.max(0)
    # Pattern coordinates: the rest pose in a box of length 1 around the origin, whatever its size.
    coordinates = ((rest - (low + high) / 2) / (high - low).max()).astype(np.float32)
    mesh.attributes.new("rest", "FLOAT_VECTOR", "POINT").data.foreach_set("vector", coordinates.ravel())
    counts = [len(part.faces) for part in parts]
    slots = np.repeat([used.index(part.paint) for part in parts], counts)
    mesh.polygons.foreach_set("material_index", slots.astype(np.int32))
    mesh.polygons.foreach_set("use_smooth", ~np.repeat([part.flat for part in parts], counts))
    for key in used:
        mesh.materials.append(_new_material(f"{name}_{key}", paints[key]))
    thing = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(thing)
    for points in frames:
        thing.shape_key_add(name="frame", from_mix=False).points.foreach_set("co", points.ravel())
    keys = mesh.shape_keys
    keys.use_relative = False
    for frame in (1, len(frames)):
        keys.eval_time = keys.key_blocks[frame - 1].frame
        keys.keyframe_insert("eval_time", frame=frame)
    _play_evenly(keys.animation_data)


def _play_evenly(animation):
    """Even playback: no easing between the first and the last key."""
    action = animation.action
    # Before 4.4 an action held its curves itself; now they are in the slot's channel bag.
    bags = [action.layers[0].strips[0].channelbag(animation.action_slot)] if hasattr(action, "layers") else [action]
    for curve in bags[0].fcurves:
        for point in curve.keyframe_points:
            point.interpolation = "LINEAR"


def _new_material(name: str, paint: Paint):
    material = bpy.data.materials.new(name)
    if material.node_tree is None:  # before Blender 5
        material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    shader = next(node for node in nodes if node.type == "BSDF_PRINCIPLED")
    shader.inputs["Roughness"].default_value = paint.roughness
    shader.inputs["Metallic"].default_value = paint.metallic
    shader.inputs["Alpha"].default_value = paint.alpha
    colours = [(*_linear_rgb(c), 1.0) for c in paint.colours]
    material.diffuse_color = shader.inputs["Base Color"].default_value = colours[0]
    if paint.pattern == "flat":
        return material
    rest = nodes.new("ShaderNodeAttribute")
    rest.attribute_name = "rest"
    fac, soft = _add_pattern(nodes, links, rest.outputs["Vector"], paint)
    ramp = nodes.new("ShaderNodeValToRGB")
    ramp.color_ramp.interpolation = "LINEAR" if soft else "CONSTANT"
    while len(ramp.color_ramp.elements) < len(colours):
        ramp.color_ramp.elements.new(0.5)
    for k, (element, value) in enumerate(zip(ramp.color_ramp.elements, colours, strict=False)):
        element.position = k / max(len(colours) - 1, 1) if soft else k / len(colours)
        element.color = value
    links.new(fac, ramp.inputs["Fac"])
    links.new(ramp.outputs["Color"], shader.inputs["Base Color"])
    return material


def _add_pattern(nodes, links, rest, paint: Paint):
    """The socket of a pattern's value in 0..1, and whether its colours blend."""
    kind, scale = paint.pattern, paint.scale
    if kind in ("gradient", "belly"):
        split = nodes.new("ShaderNodeSeparateXYZ")
        links.new(rest, split.inputs[0])
        ramp = nodes.new("ShaderNodeMapRange")
        ramp.inputs["From Min"].default_value, ramp.inputs["From Max"].default_value = -0.4, 0.4
        links.new(split.outputs[2 if kind == "belly" else paint.axis], ramp.inputs["Value"])
        return ramp.outputs[0], kind == "gradient"
    if kind == "stripes":
        node = nodes.new("ShaderNodeTexWave")
        node.bands_direction = "XYZ"[paint.axis]
        node.inputs["Scale"].default_value = scale * 0.6
        node.inputs["Distortion"].default_value = scale - 3 if scale > 4 else 0.0
        output = "Fac"
    elif kind == "checker":
        node = nodes.new("ShaderNodeTexChecker")
        node.inputs["Scale"].default_value = scale * 2 + 0.13
        output = "Fac"
    elif kind in ("noise", "patches"):
        node = nodes.new("ShaderNodeTexNoise")
        node.inputs["Scale"].default_value = scale * (2 if kind == "noise" else 1)
        output = node.outputs[0].name
    else:
        node = nodes.new("ShaderNodeTexVoronoi")
        node.inputs["Scale"].default_value = scale * 1.5
        if kind == "tiles":
            node.inputs["Randomness"].default_value = 0.0
            node.distance = "CHEBYCHEV"
        output = "Distance" if kind == "spots" else "Color"
    links.new(rest, node.inputs["Vector"])
    socket = node.outputs[output]
    if kind in ("noise", "patches"):
        # Noise lives around one half: spread it over the ramp.
        ramp = nodes.new("ShaderNodeMapRange")
        ramp.inputs["From Min"].default_value, ramp.inputs["From Max"].default_value = 0.35, 0.65
        links.new(socket, ramp.inputs["Value"])
        socket = ramp.outputs[0]
    elif output == "Color":
        split = nodes.new("ShaderNodeSeparateColor")
        links.new(socket, split.inputs[0])
        socket = split.outputs[0]
    return socket, kind == "noise"


def _linear_rgb(srgb) -> list[float]:
    return [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in srgb]
