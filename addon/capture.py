# SPDX-License-Identifier: GPL-3.0-or-later
"""What renders the pictures, in a Blender of its own (`beside`). The request:
objects    names of what is captured            cameras    names of cameras, or [] for those of `rig`
rig, targets, seed   (optional) of `datagen.rigs`: default alternating, none, 0
frames     scene frames                         in_turn    one camera a frame, instead of all of them
size, samples, passes, lighting                 as `datagen.capture.capture` has them
sequence   folder to write
"""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np

from ..datagen import rigs
from ..datagen.capture import capture
from ..datagen.scene import normalisation, versions
from ..datagen.sequence import Normalisation
from . import beside, process


def shoot(request: dict, folder: Path) -> process.Child:
    """Starts the capture of the open scene. Raises InputError."""
    return beside.start("addon.capture", request, folder)


def camera_shots(scene, cameras: list, frames: list[int], norm: Normalisation, in_turn: bool) -> list[rigs.Shot]:
    """What the scene's own cameras see at each frame (or one of them in turn), in normalised space: perspective,
    square, without lens shift."""
    shots = []
    for i, frame in enumerate(frames):
        scene.frame_set(frame)
        for ob in [cameras[i % len(cameras)]] if in_turn else cameras:
            c2w = np.array(ob.matrix_world.normalized())
            fov = float(np.degrees(ob.data.angle))
            shots.append(rigs.Shot(i, ob.name, "scene", norm.from_world(c2w), fov))
    return shots


def _capture(request: dict, progress) -> dict:
    scene, frames = bpy.context.scene, request["frames"]
    objects = [scene.objects[name] for name in request["objects"]]
    cameras = [scene.objects[name] for name in request["cameras"]]
    progress(0.02, "measuring the object")
    norm, aabb = normalisation(frames, objects, name=scene.name)
    numbers, seed, rig = range(len(frames)), request.get("seed", 0), request.get("rig")
    if cameras and not rig:
        shots = camera_shots(scene, cameras, frames, norm, request["in_turn"])
    else:
        shots = rigs.RIGS[rig or "alternating"](numbers, seed)
    shots += rigs.targets(numbers, seed, request.get("targets", 0))

    def rendered(done: int, total: int) -> None:
        progress(0.05 + 0.95 * done / total, f"rendering: picture {done} of {total}")

    settings = {key: request[key] for key in ("size", "samples", "passes", "lighting")}
    settings["provenance"] = {"asset": request["name"], **versions(), "scene_frames": frames}
    folder = Path(request["sequence"])
    capture(shots, folder, frames=frames, normalisation=norm, aabb=aabb, objects=objects, progress=rendered, **settings)
    return {"pictures": len(shots)}


if __name__ == "__main__":
    beside.serve(_capture)
