# SPDX-License-Identifier: GPL-3.0-or-later
"""The process that renders: a Blender without a window opens a copy of the artist's file and captures it.

So rendering never blocks Blender, nothing of the open scene can change, and to cancel is to end a process.
`shoot` starts it (under the add-on); `main` is what runs in it, and speaks as `process` says. The request:
    blend      copy of the file                     scripts    whether the scripts in it may run
    scene, layer   names of the scene and of its view layer
    objects    names of what is captured            cameras    names of cameras, or [] for those of `rig`
    rig, targets, seed   (optional) of `datagen.rigs`: default alternating, none, 0
    frames     scene frames                         in_turn    one camera a frame, instead of all of them
    size, samples, passes, lighting                 as `datagen.capture.capture` has them
    sequence   folder to write
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import threading
import traceback
from pathlib import Path

import bpy
import numpy as np

from ..datagen import rigs
from ..datagen.capture import capture
from ..datagen.scene import normalisation, versions
from ..datagen.sequence import InputError, Normalisation
from . import process


def shoot(request: dict, folder: Path) -> process.Child:
    """Saves a copy of the open file into the folder (nothing of the session changes, not its name either) and
    starts the process on it; adds "blend", "name" (of the artist's file) and "scripts" to the request. Raises
    InputError where the copy cannot be written."""
    blend = folder / "scene.blend"
    try:
        bpy.ops.wm.save_as_mainfile(filepath=str(blend), copy=True, compress=False, relative_remap=True)
    except RuntimeError as e:
        full = shutil.disk_usage(folder).free < 1 << 20  # Blender says "no such file" then
        why = "no space is left on the disk; make room there" if full else " ".join(str(e).split())
        raise InputError(f"{blend}: the copy to render from cannot be written: {why}.") from None
    request = request | {
        "blend": str(blend),
        "scripts": not bpy.app.autoexec_fail,
        "name": Path(bpy.data.filepath).name,
    }
    code = process.launch("addon.capture")
    program = bpy.app.binary_path  # empty where Blender is a Python module
    command = [program, "-b", "--factory-startup", "--python-exit-code", "1", "--python-expr", code]
    return process.Child(command if program else [sys.executable, "-c", code], request, folder)


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


def _capture(request: dict, say) -> int:
    say("progress", fraction=0.0, text="opening the scene")
    bpy.ops.wm.open_mainfile(filepath=request["blend"], load_ui=False, use_scripts=request["scripts"])
    scene = bpy.data.scenes[request["scene"]]
    bpy.context.window.scene = scene
    bpy.context.window.view_layer = scene.view_layers[request["layer"]]
    objects = [scene.objects[name] for name in request["objects"]]
    cameras = [scene.objects[name] for name in request["cameras"]]
    frames = request["frames"]
    say("progress", fraction=0.02, text="measuring the object")
    norm, aabb = normalisation(frames, objects, name=scene.name)
    numbers, seed, rig = range(len(frames)), request.get("seed", 0), request.get("rig")
    if cameras and not rig:
        shots = camera_shots(scene, cameras, frames, norm, request["in_turn"])
    else:
        shots = rigs.RIGS[rig or "alternating"](numbers, seed)
    shots += rigs.targets(numbers, seed, request.get("targets", 0))

    def progress(done: int, total: int) -> None:
        say("progress", fraction=0.05 + 0.95 * done / total, text=f"rendering: picture {done} of {total}")

    settings = {key: request[key] for key in ("size", "samples", "passes", "lighting")}
    folder = Path(request["sequence"])
    settings["provenance"] = {"asset": request["name"], **versions(), "scene_frames": frames}
    capture(shots, folder, frames=frames, normalisation=norm, aabb=aabb, objects=objects, progress=progress, **settings)
    return len(shots)


def main() -> int:
    """Answers one request (see the module) from standard input; returns the exit code."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what Blender prints is log

    def say(event: str, **values) -> None:
        print(json.dumps({"event": event, **values}), file=answers, flush=True)

    request = json.loads(sys.stdin.readline())
    threading.Thread(target=_leave_when_stdin_closes, daemon=True).start()
    try:
        say("done", pictures=_capture(request, say))
    except InputError as e:
        say("error", message=str(e))
        return 2
    except MemoryError:
        say("error", message="Rendering ran out of memory; choose fewer pixels or cameras.")
        return 1
    except Exception as e:
        traceback.print_exc()
        why = " ".join(str(e).split())[:300]
        say("error", message=f"Rendering stopped with {type(e).__name__}: {why}")
        return 1
    return 0


def _leave_when_stdin_closes() -> None:
    while sys.stdin.readline():
        pass
    os._exit(3)


if __name__ == "__main__":
    status = main()
    sys.stderr.flush()
    os._exit(status)  # Blender's own way out is slow
