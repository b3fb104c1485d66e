# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads a file into the emptied session by Blender's importer for its kind, and says why where Blender cannot."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from urllib.parse import unquote

import bpy

from ..sequence import InputError
from .textures import OUTSIDE, within

_BORING = re.compile(r"^(Location: |(?:Python: )?Traceback |File .*, line |raise |\^+$|\s)")  # names a place, no cause
_EXCEPTION = re.compile(r"^(?:[\w.]+\.)?\w*(?:Error|Exception|Interrupt|Exit)(?::|$)")


def import_file(path: Path, root: Path) -> None:
    """Reads the file `path`, of one of ASSET_SUFFIXES, into the open session; nothing in it is executed, and no texture
    outside of `root` becomes part of it. Raises InputError with Blender's reason."""
    try:
        _import(path, path.suffix.lower(), root)
    except RuntimeError as e:
        raise InputError(f"{path}: Blender cannot read it ({cause(str(e))}); export it again.") from None


def cause(text: str) -> str:
    """The line of an operator's error that names the cause: the last exception of a traceback, not the place in
    Blender's own code that follows it."""
    lines = [line.rstrip().removeprefix("Error: ") for line in text.splitlines() if line.strip()]
    told = [line for line in lines if not _BORING.match(line)]
    told = [line for line in told if _EXCEPTION.match(line)] or told or ["damaged"]
    return told[-1].rstrip(".")[:200]


class _GltfGuard:
    """Extends the glTF importer: by what it would read out of the root, by names that it expects, and by a rest pose,
    for it ends by playing the first animation, whose pose would overwrite that."""

    path: Path
    root: Path

    def gather_import_gltf_before_hook(self, gltf) -> None:
        for image in gltf.data.images or ():
            if not image.uri or image.uri.startswith("data:"):
                continue
            if not within(self.root, self.path.parent / unquote(image.uri)):
                image.name, image.uri = unquote(image.uri), OUTSIDE
        for i, material in enumerate(gltf.data.materials or ()):
            material.name = material.name or f"Material_{i}"  # without one a pointer animation of it is an error

    def gather_import_animations(self, animations, options, gltf) -> None:
        options.restore_first_anim = False


def _import(path: Path, suffix: str, root: Path) -> None:
    name = str(path.resolve())
    if suffix == ".blend":
        bpy.ops.wm.open_mainfile(filepath=name, load_ui=False, use_scripts=False)
    elif suffix in (".glb", ".gltf"):
        importer = sys.modules["io_scene_gltf2"]
        _GltfGuard.path, _GltfGuard.root = path.resolve(), root
        importer.glTF2ImportUserExtension = _GltfGuard  # where the importer looks for its extensions
        try:
            bpy.ops.import_scene.gltf(filepath=name)
        finally:
            del importer.glTF2ImportUserExtension
    elif suffix == ".fbx" and "fbx_import" in dir(bpy.ops.wm):  # Blender 5; the older one fails there on lights
        bpy.ops.wm.fbx_import(filepath=name)
    elif suffix == ".fbx":
        bpy.ops.import_scene.fbx(filepath=name)
    elif suffix == ".obj":
        bpy.ops.wm.obj_import(filepath=name)
    else:
        bpy.ops.wm.usd_import(filepath=name, import_all_materials=True)
