# SPDX-License-Identifier: GPL-3.0-or-later
"""Opens an asset in an emptied Blender session, safely: scripts in it never run, and what is damaged is refused.

An opened asset is never moved or re-parented: `measure.normalisation` says where it lies, and the cameras go there.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from pathlib import Path

import bpy

from ... import __version__
from .. import ASSET_SUFFIXES
from ..sequence import InputError
from .clips import Clip, find_clips, play, rest_pose
from .gltf import check_gltf
from .importers import import_file
from .left_out import left_out
from .measure import check_vertices, mesh_vertices
from .textures import replace_missing_textures
from .vertex_colours import show_vertex_colours


@dataclass
class OpenedAsset:
    """What `open_asset` found in the scene that is now open."""

    path: Path
    sha256: str  # of the file, in hexadecimal
    clips: list[Clip]  # never empty
    warnings: list[str] = field(default_factory=list)  # sentences for the user
    rest: dict = field(default_factory=dict)  # the pose as it was opened, see `clips.rest_pose`

    def play(self, clip: Clip) -> None:
        """Makes the scene show this clip, from the pose that the file was opened with."""
        play(clip, self.rest)


def empty_session() -> None:
    """An empty Blender session with factory settings."""
    bpy.ops.wm.read_factory_settings(use_empty=True)


def tool_versions() -> dict[str, str]:
    """What makes the pictures, for provenance: the versions of "blender" and "timesplat"."""
    return {"blender": bpy.app.version_string, "timesplat": __version__}


def open_asset(path: Path, root: Path | None = None) -> OpenedAsset:
    """Opens a file of one of ASSET_SUFFIXES in an emptied session. Its own lights and cameras are deleted, with their
    animations, and bone-shape objects that an importer made are hidden.

    root    folder below which the paths in the file may lead; None = the file's own
    Raises InputError: file missing, of an unknown kind or damaged; no surface; vertices that are NaN, infinite or
    beyond LARGEST_COORDINATE; data of a glTF outside of `root`. Textures that are missing or outside of it are replaced
    by light grey ones (Blender would render magenta) and named in `OpenedAsset.warnings`, as is what Blender left out.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; check the path.")
    root = Path(root or path.parent).resolve()
    suffix = path.suffix.lower()
    if suffix not in ASSET_SUFFIXES:
        raise InputError(f"{path}: files of this kind cannot be opened; give one of {', '.join(ASSET_SUFFIXES)}.")
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    if suffix in (".glb", ".gltf"):
        check_gltf(path, root)
    empty_session()
    import_file(path, root)
    enter_object_mode()
    warnings = left_out(path, root)
    gone = [ob for ob in bpy.data.objects if ob.type in ("LIGHT", "CAMERA", "LIGHT_PROBE", "SPEAKER")]
    clips = find_clips(suffix in (".glb", ".gltf", ".fbx", ".obj"), gone)
    bpy.data.batch_remove(gone)
    _hide_bone_shapes()
    _check_meshes(path)
    warnings += replace_missing_textures(path, root)
    if suffix not in (".blend", ".glb", ".gltf"):  # they say themselves what shows their colours
        show_vertex_colours()
    rest = rest_pose()  # before anything is evaluated: the first frame_set would overwrite it
    return OpenedAsset(path, digest, clips, warnings, rest)


def enter_object_mode() -> None:
    """Leaves the mode that the file was saved in: a mesh in Edit Mode is neither measured nor rendered."""
    if bpy.context.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")


def _hide_bone_shapes() -> None:
    """Importers make small meshes that draw bones; a render would show them and bounds would count them."""
    for ob in bpy.data.objects:
        for bone in ob.pose.bones if ob.pose else ():
            if bone.custom_shape:
                bone.custom_shape.hide_render = bone.custom_shape.hide_viewport = True


def _check_meshes(path: Path) -> None:
    """InputError unless there is geometry, and all of it within bounds."""
    kinds = ("curves", "metaballs", "hair_curves", "pointclouds", "volumes")
    shapes = [shape for kind in kinds for shape in getattr(bpy.data, kind, ())]
    if not shapes and not any(len(m.vertices) for m in bpy.data.meshes):
        raise InputError(f"{path}: there is no mesh in it; give a file with visible geometry.")
    for mesh in {ob.data for ob in bpy.context.scene.objects if ob.type == "MESH" and not ob.hide_render}:
        check_vertices(path, mesh.name, mesh_vertices(mesh))
