# SPDX-License-Identifier: GPL-3.0-or-later
"""How the worker is run: which Python, which checkpoint and which device, from the add-on's preferences and from what
is installed."""

from __future__ import annotations

import importlib.util
import json
import os
import sys
from pathlib import Path

import bpy

from ...datagen.sequence import InputError
from ...model.io.files import APART
from ...model.io.usd_stage import USD_SUFFIXES
from .folders import ADDON, runtime_folder

_installed: dict | None = None  # what the runtime's own file says, read once and when a Job has changed it
_named_there = False  # whether the Python that the preferences name was there when it was named
_has_torch = importlib.util.find_spec("torch") is not None  # Blender's own Python; this looks and does not import


def addon_preferences(context=None):
    """The preferences, or None where the add-on is not enabled (the package used from a script)."""
    addon = (context or bpy.context).preferences.addons.get(ADDON)
    return addon.preferences if addon else None


def installed_runtime() -> dict | None:
    """What `install` said of the installed runtime: python, build, versions, bytes; None without one."""
    return _installed


def reload_installed_runtime() -> None:
    """Reads what is installed. Draw functions rely on it: they read no files."""
    global _installed
    try:
        found = json.loads((runtime_folder() / "timesplat.json").read_text())
        _installed = {k: found[k] for k in ("python", "build", "versions", "bytes")}
    except (OSError, ValueError, KeyError, TypeError):
        _installed = None


def named_python() -> str:
    """The Python that the preferences name, or ""."""
    preferences = addon_preferences()
    return bpy.path.abspath(preferences.python) if preferences and preferences.python else ""


def look_for_named_python() -> None:
    """Looks whether it is there, for draw functions, which read no files."""
    global _named_there
    _named_there = bool(named := named_python()) and Path(named).is_file()


def is_named_python_there() -> bool:
    """As it was when it was named."""
    return _named_there


def worker_python(context=None) -> str:
    """The interpreter for the worker: the one that the preferences name, else the installed runtime's, else
    TIMESPLAT_PYTHON, else Blender's own if torch is installed there. Raises InputError where there is none."""
    preferences = addon_preferences(context)
    chosen = bpy.path.abspath(preferences.python) if preferences and preferences.python else ""
    installed = str(runtime_folder() / _installed["python"]) if _installed else ""
    for path, remedy in (
        (chosen, "correct Python in Timesplat's preferences"),
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


def has_worker_python(context=None) -> bool:
    """Whether any Python for the worker is known. For draw functions: it reads no files."""
    preferences = addon_preferences(context)
    return bool((preferences and preferences.python) or _installed or os.environ.get("TIMESPLAT_PYTHON") or _has_torch)


def python_for(suffix: str, context=None) -> str | None:
    """The interpreter that reads and writes files of a suffix; None: Blender's own. For those of APART it is the
    worker's, which has the libraries, and where a damaged file harms nothing; where there is none, USD is left to
    Blender's own pxr. Raises InputError where that lacks it too."""
    if suffix not in APART:
        return None
    try:
        return worker_python(context)
    except InputError as e:
        if suffix in USD_SUFFIXES and importlib.util.find_spec("pxr"):
            return None
        raise InputError(f"{suffix} is read and written by Timesplat's runtime. {e}") from None


def checkpoint(context=None) -> str | None:
    """The weights that the preferences name; None: those that come with Timesplat. Raises InputError."""
    preferences = addon_preferences(context)
    if not preferences or not preferences.checkpoint:
        return None
    path = bpy.path.abspath(preferences.checkpoint)
    if not Path(path).is_file():
        raise InputError(f"{path}: no such checkpoint; correct it in Timesplat's preferences, or leave it empty.")
    return path


def device(context=None) -> str:
    """cpu, cuda or mps."""
    preferences = addon_preferences(context)
    return preferences.device if preferences else "cpu"
