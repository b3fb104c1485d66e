# SPDX-License-Identifier: GPL-3.0-or-later
"""The clips of an opened asset: which actions play together, on what, from when to when.

Importers leave animations in three ways: as NLA tracks, one per object and all named alike for one clip
(glTF); as actions of which only the last is assigned (FBX, and .blend files made for games); or as what the
scene simply shows (.blend, USD). All end as a `Clip`. To play one, all NLA tracks are muted and the actions
assigned: un-muting a track after an evaluation with all muted gives frozen frames.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Collection
from dataclasses import dataclass, field, replace

import bpy

_MOVING_MODIFIERS = {  # those that can move something without any action
    *("MESH_SEQUENCE_CACHE", "NODES", "CLOTH", "SOFT_BODY", "FLUID", "OCEAN", "WAVE", "BUILD", "PARTICLE_SYSTEM"),
}


# Paths that say nothing of the object that they were made for.
_OF_EVERY_OBJECT = {
    *("location", "rotation_euler", "rotation_quaternion", "rotation_axis_angle", "scale"),
    *("hide_render", "hide_viewport", "color", "rotation_mode"),
}


@dataclass
class Clip:
    """One animation, scene frames `frame_start..frame_end` inclusive."""

    name: str
    frame_start: int
    frame_end: int
    actions: list = field(default_factory=list)  # (ID that moves, Action, slot or None); [] = the scene as it is

    def frames(self, count: int = 24, *, start: int = 0, every: int = 1, spread: bool = False) -> list[float]:
        """`count` scene frames from the one that is `start` after the first, each `every` after the one before; a
        shorter clip repeats its last. `spread`: evenly from there to the last, at fractions of frames where need be.
        A clip of one frame has one; none where `start` lies beyond the last."""
        first, last = self.frame_start + start, self.frame_end
        if first >= last:
            return [first] if first == last else []
        if spread and count > 1:
            evenly = (first + (last - first) * i / (count - 1) for i in range(count))
            return [int(f) if f == int(f) else f for f in evenly]
        return [min(first + i * every, last) for i in range(count)]

    def cut(self, count: int = 24, *, start: int = 0, every: int = 1) -> list[Clip]:
        """Consecutive clips of `count` frames, each `every` after the one before, from the one that is `start` after
        the first; the last is shorter, and is left out where it is one frame, in which nothing moves."""
        span = count * every
        starts = range(self.frame_start + start, self.frame_end + 1, span)
        ends = [min(s + span - every, self.frame_end) for s in starts]
        pieces = [(s, e) for s, e in zip(starts, ends, strict=True) if s < e or len(starts) == 1 or span == every]
        if len(pieces) == 1:
            return [replace(self, frame_start=pieces[0][0], frame_end=pieces[0][1])]
        return [
            replace(self, name=f"{self.name} {i:02d}", frame_start=s, frame_end=e) for i, (s, e) in enumerate(pieces, 1)
        ]


def find_clips(imported: bool, gone: Collection = ()) -> list[Clip]:
    """All clips of the open file. `imported`: an importer made the scene, so each group of actions is a clip;
    else the scene as it is comes first, then the actions that it does not use. `gone`: objects about to be removed;
    what animates them is no clip, and is put on nothing else. Never empty: what does not move is one clip of one frame,
    named "static"."""
    clips = _track_clips(gone) if imported else _scene_clip(gone)
    in_use = {id_.animation_data.action for id_ in _animated_ids() if id_.animation_data.action}
    in_tracks = {s.action for id_ in _animated_ids() for t in id_.animation_data.nla_tracks for s in t.strips}
    unused = [a for a in bpy.data.actions if a not in in_tracks and (imported or a not in in_use)]
    clips += _action_clips(unused, gone)
    frame = bpy.context.scene.frame_current
    return clips or [Clip("static", frame, frame)]


def _animated_ids(gone: Collection = ()) -> list:
    """Every data-block of the file that carries animation data (objects but those `gone`, shape keys, materials, …)."""
    found = []
    for name in ("objects", "shape_keys", "meshes", "armatures", "materials", "curves", "lattices", "metaballs"):
        found += [x for x in getattr(bpy.data, name, ()) if x.animation_data]
    trees = [x.node_tree for x in bpy.data.materials if x.node_tree]
    found += [x for x in (*trees, *bpy.data.node_groups) if x.animation_data]
    return [x for x in found if x not in gone]


def _scene_clip(gone: Collection) -> list[Clip]:
    """The scene as it is, where anything in it can move; else none."""
    scene = bpy.context.scene
    moves = any(
        d.animation_data.action or d.animation_data.drivers or any(not t.mute for t in d.animation_data.nla_tracks)
        for d in _animated_ids(gone)
    ) or any(
        ob.rigid_body
        or any(m.type in _MOVING_MODIFIERS for m in ob.modifiers)
        or any(c.type == "TRANSFORM_CACHE" for c in ob.constraints)
        for ob in scene.objects
        if ob not in gone
    )
    return [Clip("scene", scene.frame_start, scene.frame_end)] if moves else []


def changes_looks(clip: Clip) -> bool:
    """Whether the clip animates what a surface looks like, for which nothing has to move."""
    playing = [owner for owner, *_ in clip.actions] or _animated_ids()
    return any(isinstance(owner, bpy.types.Material | bpy.types.NodeTree) for owner in playing)


def _track_clips(gone: Collection) -> list[Clip]:
    """NLA tracks of one name, whatever they move, are one clip."""
    groups: dict[str, list] = {}
    for owner in _animated_ids(gone):
        for track in owner.animation_data.nla_tracks:
            for strip in track.strips:
                if strip.action:
                    slot = getattr(strip, "action_slot", None)
                    groups.setdefault(track.name, []).append((owner, strip.action, slot))
    return [_clip(name, actions) for name, actions in groups.items()]


def _action_clips(actions: list, gone: Collection) -> list[Clip]:
    """Actions outside of any NLA track, put on what they belong to; `Object|Take` names of different objects that
    share the take are one clip, as are the slots of one action."""
    groups: dict[str, list] = {}
    for action in actions:
        name = action.name.partition("|")[2] or action.name
        if _is_named_after(action, gone):
            continue
        fits = [(owner, *rest) for owner, *rest in _owners(action) if owner not in gone]
        taken = {owner for owner, _, _ in groups.get(name, [])}
        if taken & {owner for owner, _, _ in fits}:
            name = action.name
        if fits:
            groups.setdefault(name, []).extend(fits)
    return [_clip(name, fits) for name, fits in groups.items()]


def _is_named_after(action, gone: Collection) -> bool:
    """Whether Blender named the action by one of these objects: its FBX exporter writes each action once for every
    object, a camera's path for what stands before it as well."""
    names = [f"{ob.name}Action" for ob in gone]
    return any(re.sub(r"\.\d+$", "", part) in names for part in action.name.split("|"))


def _owners(action) -> list:
    """(ID, action, slot) for each slot of the action, on the ID that plays it, that it names, or else fits best."""
    if not hasattr(action, "slots"):  # before Blender 4.4 an action had one user, and named it at most by its own name
        name = action.name.partition("|")[0].removesuffix("Action")
        owner = _owner(action, None, action.id_root, name, action.fcurves)
        return [(owner, action, None)] if owner else []
    found = []
    for slot in action.slots:
        curves = [
            c
            for layer in action.layers
            for strip in layer.strips
            for bag in [strip.channelbag(slot)]
            if bag
            for c in bag.fcurves
        ]
        owner = _owner(action, slot, slot.target_id_type, slot.name_display, curves)
        if owner:
            found.append((owner, action, slot))
    return found


def _owner(action, slot, kind: str, name: str, curves):
    """The ID of this kind whose animation the curves are: the one that plays them, or that their slot names (also by
    the name that it had when it last played them); else the one that most of them fit, if what they move is not what
    every object has. None where none is found: what was a deleted camera's path moves nothing else."""
    pools = {"OBJECT": bpy.data.objects, "KEY": bpy.data.shape_keys, "MATERIAL": bpy.data.materials}
    pools["ARMATURE"], pools["MESH"] = bpy.data.armatures, bpy.data.meshes
    pool = [id_ for id_ in pools.get(kind, ()) if _resolved(id_, curves)]
    if not pool:
        return None
    playing = [id_ for id_ in pool if _plays(id_, action, slot)]
    named = [id_ for id_ in pool if id_.name == name or _last_played(id_, slot)]
    if kind == "OBJECT" and not playing and not named and all(_fits_any_object(c) for c in curves):
        return pool[0] if len(bpy.data.objects) == 1 else None
    most = max(_resolved(id_, curves) for id_ in pool)
    fitting = [id_ for id_ in pool if _resolved(id_, curves) == most]
    for preferred in (playing, named, [id_ for id_ in fitting if id_.animation_data]):
        if best := [id_ for id_ in preferred if id_ in fitting]:
            return best[0]
    return fitting[0]


def _resolved(id_, curves) -> int:
    """How many of the curves animate something that the ID has."""
    found = 0
    for curve in curves:
        with contextlib.suppress(ValueError):
            id_.path_resolve(curve.data_path)
            found += 1
    return found


def _fits_any_object(curve) -> bool:
    return curve.data_path.removeprefix("delta_") in _OF_EVERY_OBJECT


def _plays(id_, action, slot) -> bool:
    data = id_.animation_data
    return bool(data) and data.action == action and (slot is None or data.action_slot == slot)


def _last_played(id_, slot) -> bool:
    data = id_.animation_data
    return bool(data) and slot is not None and data.last_slot_identifier == slot.identifier


def _clip(name: str, actions: list) -> Clip:
    """A clip as long as the longest of its actions."""
    ranges = [action.curve_frame_range for _, action, _ in actions]
    start = math.floor(min(r[0] for r in ranges) + 1e-4)
    return Clip(name, start, max(start, math.ceil(max(r[1] for r in ranges) - 1e-4)), actions)


# ---------------------------------------------------------------- playing


def rest_pose() -> dict:
    """The pose of everything that a clip may move: what the next clip does not animate goes back to it."""
    rest = {}
    for ob in bpy.data.objects:
        rest[ob] = ob.matrix_basis.copy()
        for bone in ob.pose.bones if ob.pose else ():
            rest[bone] = bone.matrix_basis.copy()
    for keys in bpy.data.shape_keys:
        for block in keys.key_blocks:
            rest[block] = block.value
    return rest


def play(clip: Clip, rest: dict) -> None:
    """Makes the open scene show `clip`; see the module's text. The scene as it is needs nothing."""
    if not clip.actions:
        return
    for id_ in _animated_ids():
        for track in id_.animation_data.nla_tracks:
            track.mute, track.is_solo = True, False
        id_.animation_data.action = None
    for item, value in rest.items():
        if isinstance(value, float):
            item.value = value
        else:
            item.matrix_basis = value
    for id_, action, slot in clip.actions:
        data = id_.animation_data or id_.animation_data_create()
        data.action = action
        if slot is not None:
            data.action_slot = slot
