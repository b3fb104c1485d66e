# SPDX-License-Identifier: GPL-3.0-or-later
"""Plays physics that is not baked, so that frames can be rendered one by one."""

from __future__ import annotations

import bpy


def simulate(last: int) -> None:
    """Plays the open scene up to scene frame `last` where something is simulated and not baked: physics goes from frame
    to frame and stands still where one jumps. Rigid bodies become keyframes, for they move in no copy of their scene;
    call it only where the session is thrown away."""
    scene = bpy.context.scene
    caches = []
    for ob in bpy.data.objects:
        caches += [m.point_cache for m in ob.modifiers if m.type in ("CLOTH", "SOFT_BODY")]
        caches += [p.point_cache for p in ob.particle_systems]
    starts = [c.frame_start for c in caches if not c.is_baked]
    if any(n.bl_idname == "GeometryNodeSimulationOutput" for g in bpy.data.node_groups for n in g.nodes):
        starts.append(scene.frame_start)
    for frame in range(min(starts), last + 1) if starts else ():
        scene.frame_set(frame)
    if scene.rigidbody_world:
        _key_rigid_bodies(scene, last)


def _key_rigid_bodies(scene, last: int) -> None:
    """Plays the rigid bodies and replaces them by keyframes of where they were."""
    frames = range(scene.rigidbody_world.point_cache.frame_start, last + 2)  # motion vectors look one ahead
    bodies = [ob for ob in scene.objects if ob.rigid_body and ob.rigid_body.type == "ACTIVE"]
    poses = []
    for frame in frames:
        scene.frame_set(frame)
        poses.append([ob.matrix_world.copy() for ob in bodies])
    bpy.ops.rigidbody.world_remove()
    for ob in bodies:
        ob.rotation_mode = "QUATERNION"
    for frame, poses_then in zip(frames, poses, strict=True):
        scene.frame_set(frame)
        for ob, pose in zip(bodies, poses_then, strict=True):
            ob.matrix_world = pose
            ob.keyframe_insert("location", frame=frame)
            ob.keyframe_insert("rotation_quaternion", frame=frame)
