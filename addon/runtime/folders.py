# SPDX-License-Identifier: GPL-3.0-or-later
"""Folders of the add-on's own, kept between sessions: "runs" for what Jobs write, "runtime" for the installed one."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import bpy

from ...datagen.whole_folders import WINDOWS

ADDON = __package__.rsplit(".", 2)[0]  # what Blender knows the add-on by


def user_folder(name: str, create: bool = True) -> Path:
    """A folder for files of the add-on's own, kept between sessions. On Windows it is not one of Blender's: below
    those torch's files exceed the 260 characters that a path may have, and they follow users to other computers."""
    if WINDOWS and (local := os.environ.get("LOCALAPPDATA")):
        folder = Path(local, "Timesplat", ".".join(map(str, bpy.app.version[:2])), name)
        if create:
            folder.mkdir(parents=True, exist_ok=True)
        return folder
    if ADDON.startswith("bl_ext."):
        return Path(bpy.utils.extension_path_user(ADDON, path=name, create=create))
    folder = bpy.utils.user_resource("DATAFILES", path=f"{ADDON}/{name}", create=create)
    if not folder:  # a home that cannot be written
        folder = Path(tempfile.gettempdir(), ADDON, name)
        if create:
            folder.mkdir(parents=True, exist_ok=True)
    return Path(folder)


def runtime_folder() -> Path:
    """Where the installed runtime lies, a virtual environment, if there is one."""
    return user_folder("runtime", create=False) / "venv"
