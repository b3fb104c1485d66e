# SPDX-License-Identifier: GPL-3.0-or-later
"""Renders the pictures, in a background Blender (`background_blender`). The request:
objects    full names of what is captured       cameras    full names of cameras, or [] for those of `rig`
rig, targets, seed   (optional) of `datagen.rigs`: default coverage, none, 0
frames     scene frames of which pictures are taken, evenly apart
last       (optional) up to this scene frame surfaces are followed between them too
in_turn    one camera a frame, instead of all of them
size, samples, passes, lighting                 as `datagen.render_setup.CaptureSettings` has them
tracks     (optional) how many points of surfaces are followed, 0 for one a pixel (the default); None: none
sequence   folder to write
"""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np

from ...datagen import rigs
from ...datagen.capture import Subject, capture
from ...datagen.render_setup import CaptureSettings
from ...datagen.scene.measure import normalisation
from ...datagen.scene.open import tool_versions
from ...datagen.scene.simulate import simulate
from ...datagen.scene.surfaces import MOST_FLOATS, follow_surfaces
from ...datagen.sequence import InputError, Normalisation
from ...datagen.tracks import MOST
from ..asset.visibility import HIDDEN
from . import background_blender, child_process

LOOKS = 4  # frames by which it is judged whether all can be followed


def start_capture(request: dict, folder: Path) -> child_process.Child:
    """Starts the capture of the open scene. Raises InputError."""
    return background_blender.start("addon.runtime.capture", request, folder)


def clip_frames(request: dict, norm: Normalisation, objects: list) -> list[int]:
    """The scene frames of the clip: those of the pictures, and between them and up to the request's `last` as many,
    just as evenly, as there is memory for to follow surfaces through: all of them, as a rule. None between where
    something cannot be followed: motion vectors lead it from picture to picture."""
    taken, last = request["frames"], request.get("last")
    if last is None or len(taken) < 2 or (every := taken[1] - taken[0]) == 1:
        return taken
    surfaces, untracked = follow_surfaces(taken[:: -(-len(taken) // LOOKS)], norm, objects)
    if untracked:
        return taken
    points = request["tracks"] or min(request["size"] ** 2, MOST)
    most = MOST_FLOATS // max(sum(s.vertices[0].size for s in surfaces), 7 * points)
    for step in range(1, every):
        if every % step == 0 and len(frames := range(taken[0], last + 1, step)) <= most:
            return list(frames)
    return taken


def camera_shots(scene, cameras: list, frames: dict[int, int], norm: Normalisation, in_turn: bool) -> list[rigs.Shot]:
    """What the scene's own cameras see at each frame (or one of them in turn), in normalised space: perspective,
    square. frames: number in the clip -> scene frame. What is hidden in the viewport or in an excluded collection is
    not evaluated: it is linked and shown."""
    for ob in cameras:
        if scene.collection not in ob.users_collection:
            scene.collection.objects.link(ob)
        ob.hide_viewport = False
        ob.hide_set(False)
    shots = []
    for i, (number, frame) in enumerate(frames.items()):
        scene.frame_set(frame)
        for ob in [cameras[i % len(cameras)]] if in_turn else cameras:
            fov, shift = float(np.degrees(ob.data.angle)), (ob.data.shift_x, ob.data.shift_y)
            shots.append(rigs.Shot(number, ob.name_full, "scene", norm.from_world(rigid_pose(ob)), fov, shift))
    return shots


def rigid_pose(ob) -> np.ndarray:
    """(4,4) float64: where a camera stands, which way it looks and which way is up, without scale, mirroring or shear.
    Raises InputError where its scale leaves no direction."""
    c2w = np.array(ob.matrix_world)
    back, up = c2w[:3, 2], c2w[:3, 1]
    right = np.cross(up, back)
    lengths = [np.linalg.norm(v) for v in (back, up, right)]
    if not min(lengths) > 1e-6 * max(lengths[:2]) ** 2:
        raise InputError(f"{ob.name}: a camera of scale 0 looks nowhere; apply another scale or unselect it.")
    c2w[:3, 0], c2w[:3, 2] = right / lengths[2], back / lengths[0]
    c2w[:3, 1] = np.cross(c2w[:3, 2], c2w[:3, 0])
    return c2w


def _capture(request: dict, progress) -> dict:
    scene = bpy.context.scene
    by_name = {ob.name_full: ob for ob in scene.objects}  # names alone are not unique: two libraries may use one
    objects, cameras = ([by_name[n] for n in request[key]] for key in ("objects", "cameras"))
    for ob in objects:
        if ob.get(HIDDEN):
            ob.hide_render = False
    progress(0.02, "measuring the object")
    simulate(max(request["frames"][-1], request.get("last") or 0))
    norm, aabb = normalisation(request["frames"], objects, name=scene.name)
    frames = clip_frames(request, norm, objects)
    taken, seed, rig = {frames.index(f): f for f in request["frames"]}, request.get("seed", 0), request.get("rig")
    if cameras and not rig:
        shots = camera_shots(scene, cameras, taken, norm, request["in_turn"])
    else:
        shots = rigs.RIGS[rig or "coverage"](list(taken), seed)
    shots += rigs.targets(list(taken), seed, request.get("targets", 0))

    def rendered(done: int, total: int) -> None:
        progress(0.05 + 0.95 * done / total, f"rendering: picture {done} of {total}")

    wanted = {key: request[key] for key in ("size", "samples", "passes", "lighting")}
    settings = CaptureSettings(**wanted, tracks=request.get("tracks", 0))
    subject = Subject(frames, norm, aabb, objects)
    provenance = {"asset": request["name"], **tool_versions(), "scene_frames": frames}
    capture(shots, Path(request["sequence"]), subject, settings, provenance=provenance, progress=rendered)
    return {"pictures": len(shots)}


if __name__ == "__main__":
    background_blender.serve(_capture)
