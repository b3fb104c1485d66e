# SPDX-License-Identifier: GPL-3.0-or-later
"""A Blender in the background: a process without a window that opens a copy of the artist's file and does one thing.

So rendering never blocks the artist's Blender, nothing of the open scene can change, to cancel is to end a process, and
a crash is a sentence. `start` belongs to the artist's Blender; a module that runs in the background ends with
`serve(do)`, and speaks as `child_process` says.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import threading
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

import bpy
from bpy.app.handlers import persistent

from ...datagen.sequence import InputError
from . import child_process

_texts_at_opening: set[str] | None = None  # of the file, those that ran when it was opened; None: not known


def start(module: str, request: dict, folder: Path) -> child_process.Child:
    """Saves a copy of the open file and of its caches into the folder (nothing of the session changes, not its name
    either) and starts `timesplat.<module>` on it, with the open scene and view layer. Raises InputError where the copy
    cannot be written, or would run a text that was not there when the file was opened: one that was appended, perhaps,
    and that Blender itself has not run."""
    scripts = not bpy.app.autoexec_fail  # whether those in the file may run: as here
    if scripts and _texts_at_opening is not None and (new := _registered_texts() - _texts_at_opening):
        raise InputError(
            f"{min(new)}: this text came after the file was opened, and its Register is on, so that it would run in "
            "the copy that is rendered; switch Register off, or, if you trust it, save and open the file again."
        )
    blend = folder / "scene.blend"
    opened = Path(bpy.data.filepath)
    caches = opened.parent / f"blendcache_{opened.stem}"  # where Blender looks for physics that is kept on the disk
    try:
        bpy.ops.wm.save_as_mainfile(filepath=str(blend), copy=True, compress=False, relative_remap=True)
        if opened.name and caches.is_dir():  # copied, for what is not baked is written there
            shutil.copytree(caches, folder / f"blendcache_{blend.stem}")
    except (RuntimeError, OSError) as e:
        full = shutil.disk_usage(folder).free < 1 << 20  # Blender says "no such file" then
        why = "no space is left on the disk; make room there" if full else " ".join(str(e).split())
        raise InputError(f"{blend}: the copy to render from cannot be written: {why}.") from None
    request = request | {
        "blend": str(blend),
        "name": opened.name,
        "scripts": scripts,
        "scene": bpy.context.scene.name,
        "layer": bpy.context.view_layer.name,
    }
    code = child_process.launch(module)
    program = bpy.app.binary_path  # empty where Blender is a Python module
    command = [program, "-b", "--factory-startup", "--python-exit-code", "1", "--python-expr", code]
    return child_process.Child(command if program else [sys.executable, "-c", code], request, folder)


def serve(do: Callable[[dict, Callable], dict]) -> NoReturn:
    """Answers the one request on standard input and ends the process: opens the file, calls `do(request, progress)`,
    whose dict goes into the "done" event; `progress(fraction, text)`."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what Blender prints is log

    def say(event: str, **values) -> None:
        print(json.dumps({"event": event, **values}), file=answers, flush=True)

    def progress(fraction: float, text: str) -> None:
        say("progress", fraction=fraction, text=text)

    request = json.loads(sys.stdin.readline())
    pipe = os.dup(0)
    with open(os.devnull) as nothing:
        os.dup2(nothing.fileno(), 0)  # on Windows what inherits a pipe that is being read hangs (cpython #78961)
    threading.Thread(target=_leave_when_closed, args=[pipe], daemon=True).start()
    code = 1
    try:
        progress(0.0, "opening the scene")
        bpy.ops.wm.open_mainfile(filepath=request["blend"], load_ui=False, use_scripts=request["scripts"])
        window, scene = bpy.context.window, bpy.data.scenes[request["scene"]]
        window.scene = scene
        window.view_layer = scene.view_layers[request["layer"]]
        say("done", **do(request, progress))
        code = 0
    except InputError as e:
        say("error", message=str(e))
    except MemoryError:
        say("error", message="Rendering ran out of memory; choose fewer pixels or cameras.")
    except Exception as e:
        traceback.print_exc()
        say("error", message=f"Rendering stopped with {type(e).__name__}: {' '.join(str(e).split())[:300]}")
    sys.stderr.flush()
    os._exit(code)  # Blender's own way out is slow


def _leave_when_closed(pipe: int) -> None:
    """For a thread: ends the process when Blender is gone. (`model.worker` and `install` do so in their own words: they
    run under a Python without Blender, `install` even without this package.)"""
    while os.read(pipe, 1 << 16):
        pass
    os._exit(3)


def _registered_texts() -> set[str]:
    """Names of the texts that Blender runs when it opens the file."""
    return {text.name for text in bpy.data.texts if text.use_module}


@persistent
def _remember_texts(*_) -> None:
    global _texts_at_opening
    _texts_at_opening = _registered_texts()


def register() -> None:
    bpy.app.timers.register(_remember_texts)  # no file can be looked into while add-ons are registered
    bpy.app.handlers.load_post.append(_remember_texts)


def unregister() -> None:
    bpy.app.handlers.load_post.remove(_remember_texts)
    if bpy.app.timers.is_registered(_remember_texts):
        bpy.app.timers.unregister(_remember_texts)
