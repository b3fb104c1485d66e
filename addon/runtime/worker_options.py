# SPDX-License-Identifier: GPL-3.0-or-later
"""The add-on's preferences: which Python runs the worker, which checkpoint and device it takes, and where files of
the add-on's own lie. What the buttons do stands in `setup`.
"""

from __future__ import annotations

import importlib.util
import json
import os
import sys
import tempfile
from pathlib import Path

import bpy
from bpy.props import EnumProperty, StringProperty

from ...datagen.sequence import WINDOWS, InputError

ROOT = __package__.rsplit(".", 2)[0]  # what Blender knows the add-on by
DEVICES = [
    ("cpu", "CPU", "The processor: runs everywhere"),
    ("cuda", "CUDA", "An NVIDIA GPU; needs a runtime with CUDA"),
    ("mps", "Metal", "A GPU of Apple"),
]
_installed: dict | None = None  # what the runtime's own file says, read once and when a Job has changed it
_has_torch = importlib.util.find_spec("torch") is not None  # Blender's own Python; this looks and does not import


class TIMESPLAT_preferences(bpy.types.AddonPreferences):
    bl_idname = ROOT

    python: StringProperty(
        name="Python",
        description="An interpreter with torch and the rest of timesplat[torch]. Empty: the installed runtime, else "
        "TIMESPLAT_PYTHON, else Blender's own",
        subtype="FILE_PATH",
    )
    checkpoint: StringProperty(
        name="Checkpoint",
        description="Weights (.safetensors) in place of those that come with Timesplat",
        subtype="FILE_PATH",
    )
    device: EnumProperty(name="Device", description="Where networks and refinement run", items=DEVICES, default="cpu")

    def draw(self, context):
        from ..operators import runtime_buttons

        layout = self.layout
        layout.use_property_split = True
        layout.prop(self, "python")
        layout.prop(self, "checkpoint")
        layout.prop(self, "device")
        runtime_buttons.draw(layout)


def get(context=None):
    """The preferences, or None where the add-on is not enabled (the package used from a script)."""
    addon = (context or bpy.context).preferences.addons.get(ROOT)
    return addon.preferences if addon else None


def user_folder(name: str, create: bool = True) -> Path:
    """A folder for files of the add-on's own, kept between sessions. On Windows it is not one of Blender's: below
    those torch's files exceed the 260 characters that a path may have, and they follow users to other computers."""
    if WINDOWS and (local := os.environ.get("LOCALAPPDATA")):
        folder = Path(local, "Timesplat", ".".join(map(str, bpy.app.version[:2])), name)
        if create:
            folder.mkdir(parents=True, exist_ok=True)
        return folder
    if ROOT.startswith("bl_ext."):
        return Path(bpy.utils.extension_path_user(ROOT, path=name, create=create))
    folder = bpy.utils.user_resource("DATAFILES", path=f"{ROOT}/{name}", create=create)
    if not folder:  # a home that cannot be written
        folder = Path(tempfile.gettempdir(), ROOT, name)
        if create:
            folder.mkdir(parents=True, exist_ok=True)
    return Path(folder)


def runtime_folder() -> Path:
    """Where the installed runtime lies, a virtual environment, if there is one."""
    return user_folder("runtime", create=False) / "venv"


def runtime() -> dict | None:
    """What `runtime.install` said of the installed runtime: python, build, versions, bytes; None without one."""
    return _installed


def look_again() -> None:
    """Reads what is installed. Draw functions rely on it: they read no files."""
    global _installed
    try:
        told = json.loads((runtime_folder() / "timesplat.json").read_text())
        _installed = {k: told[k] for k in ("python", "build", "versions", "bytes")}
    except (OSError, ValueError, KeyError, TypeError):
        _installed = None


def worker_python(context=None) -> str:
    """The interpreter for the worker: the one that the preferences name, else the installed runtime's, else
    TIMESPLAT_PYTHON, else Blender's own if torch is installed there. Raises InputError where there is none."""
    preferences = get(context)
    named = bpy.path.abspath(preferences.python) if preferences and preferences.python else ""
    installed = str(runtime_folder() / _installed["python"]) if _installed else ""
    for path, remedy in (
        (named, "correct Python in Timesplat's preferences"),
        (installed, "the Blender that the runtime was made with is gone; install the runtime again"),
        (os.environ.get("TIMESPLAT_PYTHON"), "correct TIMESPLAT_PYTHON"),
    ):
        if path:
            if not Path(path).is_file():
                raise InputError(f"{path}: no such file; {remedy}.")
            return path
    if _has_torch:
        return sys.executable
    raise InputError(
        "No Python with torch is known: press Install Runtime in Timesplat's preferences, or name there a Python "
        "that has timesplat[torch]."
    )


def named(context=None) -> bool:
    """Whether any Python for the worker is known. For draw functions: it reads no files."""
    preferences = get(context)
    return bool((preferences and preferences.python) or _installed or os.environ.get("TIMESPLAT_PYTHON") or _has_torch)


def usd_python(context=None) -> str | None:
    """The interpreter that reads and writes USD: the worker's, which knows splats and has their validator, and where
    a damaged file harms nothing; None where there is none, but Blender's own has pxr. Raises InputError otherwise."""
    try:
        return worker_python(context)
    except InputError:
        if importlib.util.find_spec("pxr"):
            return None
        raise


def checkpoint(context=None) -> str | None:
    """The weights that the preferences name; None: those that come with Timesplat. Raises InputError."""
    preferences = get(context)
    if not preferences or not preferences.checkpoint:
        return None
    path = bpy.path.abspath(preferences.checkpoint)
    if not Path(path).is_file():
        raise InputError(f"{path}: no such checkpoint; correct it in Timesplat's preferences, or leave it empty.")
    return path


def device(context=None) -> str:
    """cpu, cuda or mps."""
    preferences = get(context)
    return preferences.device if preferences else "cpu"


def register() -> None:
    bpy.utils.register_class(TIMESPLAT_preferences)
    look_again()


def unregister() -> None:
    bpy.utils.unregister_class(TIMESPLAT_preferences)
