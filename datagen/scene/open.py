# SPDX-License-Identifier: GPL-3.0-or-later
"""Opens an asset in an emptied Blender session, safely: scripts in it never run, and what is damaged is refused.

An opened asset is never moved or re-parented: `measure.normalisation` says where it lies, and the cameras go there.
"""

from __future__ import annotations

import hashlib
import sys
from dataclasses import dataclass, field
from pathlib import Path

import bpy

from ... import __version__
from .. import ASSET_SUFFIXES
from ..sequence import InputError
from .clips import Clip, find_clips, play, rest_pose
from .gltf import check_gltf, inside_folder
from .measure import check_vertices, mesh_vertices


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


def open_asset(path: Path) -> OpenedAsset:
    """Opens a file of one of ASSET_SUFFIXES in an emptied session. Its own lights and cameras are deleted,
    bone-shape objects that an importer made are hidden.

    Raises InputError: file missing, of an unknown kind or damaged; no mesh; vertices that are NaN, infinite
    or beyond 1e6; a texture path that leads out of the file's folder. A texture that is merely missing is
    replaced by a light grey one (Blender would render magenta) and named in `OpenedAsset.warnings`.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; check the path.")
    suffix = path.suffix.lower()
    if suffix not in ASSET_SUFFIXES:
        raise InputError(f"{path}: files of this kind cannot be opened; give one of {', '.join(ASSET_SUFFIXES)}.")
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    if suffix in (".glb", ".gltf"):
        check_gltf(path)
    empty_session()
    try:
        _import_file(path, suffix)
    except RuntimeError as e:
        reason = str(e).strip().splitlines()[-1].removeprefix("Error: ").rstrip(".") if str(e) else "damaged"
        raise InputError(f"{path}: Blender cannot read it ({reason}); export it again.") from None
    enter_object_mode()
    _remove_lights_and_cameras()
    _hide_bone_shapes()
    _check_meshes(path)
    warnings = _replace_missing_textures(path)
    rest = rest_pose()  # before anything is evaluated: the first frame_set would overwrite it
    imported = suffix in (".glb", ".gltf", ".fbx", ".obj")
    return OpenedAsset(path, digest, find_clips(imported), warnings, rest)


def enter_object_mode() -> None:
    """Leaves the mode that the file was saved in: a mesh in Edit Mode is neither measured nor rendered."""
    if bpy.context.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")


class _KeepRestPose:
    """Extends the glTF importer, which ends by playing the first animation: its pose would overwrite the rest pose."""

    def gather_import_animations(self, animations, options, gltf) -> None:
        options.restore_first_anim = False


def _import_file(path: Path, suffix: str) -> None:
    name = str(path.resolve())
    if suffix == ".blend":
        bpy.ops.wm.open_mainfile(filepath=name, load_ui=False, use_scripts=False)
    elif suffix in (".glb", ".gltf"):
        importer = sys.modules["io_scene_gltf2"]
        importer.glTF2ImportUserExtension = _KeepRestPose  # where the importer looks for its extensions
        try:
            bpy.ops.import_scene.gltf(filepath=name)
        finally:
            del importer.glTF2ImportUserExtension
    elif suffix == ".fbx" and hasattr(bpy.types, "WM_OT_fbx_import"):
        bpy.ops.wm.fbx_import(filepath=name)
    elif suffix == ".fbx":
        bpy.ops.import_scene.fbx(filepath=name)
    elif suffix == ".obj":
        bpy.ops.wm.obj_import(filepath=name)
    else:
        bpy.ops.wm.usd_import(filepath=name, import_all_materials=True)


def _remove_lights_and_cameras() -> None:
    for ob in list(bpy.data.objects):
        if ob.type in ("LIGHT", "CAMERA", "LIGHT_PROBE", "SPEAKER"):
            bpy.data.objects.remove(ob)


def _hide_bone_shapes() -> None:
    """Importers make small meshes that draw bones; a render would show them and bounds would count them."""
    for ob in bpy.data.objects:
        for bone in ob.pose.bones if ob.pose else ():
            if bone.custom_shape:
                bone.custom_shape.hide_render = bone.custom_shape.hide_viewport = True


def _check_meshes(path: Path) -> None:
    """InputError unless there is geometry, and all of it within bounds."""
    shapes = (*bpy.data.curves, *bpy.data.metaballs)
    meshes = {ob.data for ob in bpy.context.scene.objects if ob.type == "MESH" and not ob.hide_render}
    if not shapes and not any(len(m.vertices) for m in meshes):
        raise InputError(f"{path}: there is no mesh in it; give a file with visible geometry.")
    for mesh in meshes:
        check_vertices(path, mesh.name, mesh_vertices(mesh))


def _replace_missing_textures(path: Path) -> list[str]:
    """Light grey instead of magenta; the warnings. InputError for a texture outside of the asset's folder."""
    warnings = []
    for image in bpy.data.images:
        if image.source not in ("FILE", "SEQUENCE", "MOVIE", "TILED"):
            continue
        if not image.packed_file and image.filepath:
            inside_folder(path, bpy.path.abspath(image.filepath, library=image.library))
        if image.users and not (image.has_data or image.size[0]):  # size[0] makes Blender try to load it
            warnings.append(f"{path}: the texture {image.name} is missing or damaged; it is rendered light grey.")
            image.source = "GENERATED"
            image.generated_width = image.generated_height = 1
            image.generated_color = (0.8, 0.8, 0.8, 1.0)
    return warnings
