# SPDX-License-Identifier: GPL-3.0-or-later
"""Opens an asset in Blender safely, finds its clips, measures it; and lends a scene out unharmed.

An opened asset is never moved or re-parented: `normalisation` says where it lies, and the cameras go there.
"""

from __future__ import annotations

import contextlib
import hashlib
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import bpy
import numpy as np

from . import ASSET_SUFFIXES, gltf
from .clips import Clip, find_clips, play, rest_pose
from .gltf import LARGEST
from .sequence import InputError, Normalisation


@dataclass
class Asset:
    """What `open_asset` found in the scene that is now open."""

    path: Path
    sha256: str
    clips: list[Clip]
    warnings: list[str] = field(default_factory=list)
    rest: dict = field(default_factory=dict)

    def play(self, clip: Clip) -> None:
        """Makes the scene show this clip, from the pose that the file was opened with."""
        play(clip, self.rest)


def empty() -> None:
    """An empty Blender session with factory settings."""
    bpy.ops.wm.read_factory_settings(use_empty=True)


def versions() -> dict:
    """What made the pictures, for provenance."""
    from .. import __version__

    return {"blender": bpy.app.version_string, "timesplat": __version__}


def open_asset(path: Path) -> Asset:
    """Opens a file of one of ASSET_SUFFIXES in an emptied session; scripts in it never run. Its own lights and
    cameras are deleted, bone-shape objects that an importer made are hidden.

    Raises InputError: file missing, of an unknown kind or damaged; no mesh; vertices that are NaN, infinite
    or beyond 1e6; a texture path that leads out of the file's folder. A texture that is merely missing is
    replaced by a light grey one (Blender would render magenta) and named in `Asset.warnings`.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; check the path.")
    suffix = path.suffix.lower()
    if suffix not in ASSET_SUFFIXES:
        raise InputError(f"{path}: files of this kind cannot be opened; give one of {', '.join(ASSET_SUFFIXES)}.")
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    if suffix in (".glb", ".gltf"):
        gltf.check(path)
    empty()
    try:
        _load(path, suffix)
    except RuntimeError as e:
        reason = str(e).strip().splitlines()[-1].removeprefix("Error: ").rstrip(".") if str(e) else "damaged"
        raise InputError(f"{path}: Blender cannot read it ({reason}); export it again.") from None
    object_mode()
    for ob in list(bpy.data.objects):
        if ob.type in ("LIGHT", "CAMERA", "LIGHT_PROBE", "SPEAKER"):
            bpy.data.objects.remove(ob)
    _hide_bone_shapes()
    _check_meshes(path)
    warnings = _check_textures(path)
    rest = rest_pose()  # before anything is evaluated: the first frame_set would overwrite it
    imported = suffix in (".glb", ".gltf", ".fbx", ".obj")
    return Asset(path, digest, find_clips(imported), warnings, rest)


def object_mode() -> None:
    """Leaves the mode that the file was saved in: a mesh in Edit Mode is neither measured nor rendered."""
    if bpy.context.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")


class _KeepRestPose:
    """The glTF importer ends by playing the first animation, whose pose then overwrites the rest pose."""

    def gather_import_animations(self, animations, options, gltf) -> None:
        options.restore_first_anim = False


def _load(path: Path, suffix: str) -> None:
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


def _hide_bone_shapes() -> None:
    """Importers make small meshes that draw bones; a render would show them and bounds would count them."""
    for ob in bpy.data.objects:
        for bone in ob.pose.bones if ob.pose else ():
            if bone.custom_shape:
                bone.custom_shape.hide_render = bone.custom_shape.hide_viewport = True


def _check_meshes(path: Path) -> None:
    shapes = (*bpy.data.curves, *bpy.data.metaballs)
    meshes = {ob.data for ob in bpy.context.scene.objects if ob.type == "MESH" and not ob.hide_render}
    if not shapes and not any(len(m.vertices) for m in meshes):
        raise InputError(f"{path}: there is no mesh in it; give a file with visible geometry.")
    for mesh in meshes:
        check_vertices(path, mesh.name, vertices(mesh))


def check_vertices(path: Path, name: str, points: np.ndarray) -> None:
    """InputError unless all coordinates are finite and within LARGEST."""
    if points.size and not np.abs(points).max() <= LARGEST:
        raise InputError(
            f"{path}: the mesh {name} has vertices that are not finite or beyond {LARGEST:.0e}; repair it."
        )


def _check_textures(path: Path) -> list[str]:
    warnings = []
    for image in bpy.data.images:
        if image.source not in ("FILE", "SEQUENCE", "MOVIE", "TILED"):
            continue
        if not image.packed_file and image.filepath:
            gltf.inside(path, bpy.path.abspath(image.filepath, library=image.library))
        if image.users and not (image.has_data or image.size[0]):  # size[0] makes Blender try to load it
            warnings.append(f"{path}: the texture {image.name} is missing or damaged; it is rendered light grey.")
            image.source = "GENERATED"
            image.generated_width = image.generated_height = 1
            image.generated_color = (0.8, 0.8, 0.8, 1.0)
    return warnings


# ---------------------------------------------------------------- lending the scene

_LEFT_OUT = ("CAMERA", "GPENCIL", "GREASEPENCIL")


def shown_objects(scene, view_layer) -> list:
    """The objects of the scene that a render of the view layer could show: those in a collection that is
    neither excluded nor hidden from renders. (An object's own hide_render may be animated; it is kept.)"""
    shown = set()

    def walk(layer, hidden):
        hidden = hidden or layer.exclude or layer.collection.hide_render
        if not hidden:
            shown.update(layer.collection.objects)
        for child in layer.children:
            walk(child, hidden)

    walk(view_layer.layer_collection, False)
    return [ob for ob in scene.objects if ob in shown]


@contextlib.contextmanager
def borrowed(objects: list | None = None, *, lights: bool = True) -> Iterator:
    """A throw-away copy of the open scene with one view layer, to change and to step through at will.

    objects: what it contains; None = all that renders show; lights False leaves light objects out. Cameras are left
    out, and so are Grease Pencil, which has no depth, and shadow catchers, which are no things. Without a window
    the copy stands in for the scene wherever this is referred to: a driver that reads the scene's frame would stand
    still otherwise.
    On leaving, the copy is gone and, without a window, the scene's own frame is evaluated again. With one it was never
    touched, and an artist's pose that has no key yet would be lost.
    """
    source, layer = bpy.context.scene, bpy.context.view_layer
    keep = shown_objects(source, layer) if objects is None else list(objects)
    stage = source.copy()
    try:
        for other in [x for x in stage.view_layers if x.name != layer.name]:
            stage.view_layers.remove(other)
        for child in stage.view_layers[0].layer_collection.children:
            child.exclude = True  # to unlink them has crashed Blender 5.2 while a 3D view was rendering
        for ob in list(stage.collection.objects):
            stage.collection.objects.unlink(ob)
        for ob in keep:
            if lights if ob.type == "LIGHT" else ob.type not in _LEFT_OUT and not ob.is_shadow_catcher:
                stage.collection.objects.link(ob)
        stage.timeline_markers.clear()  # those with a camera would switch to it
        stage.background_set = None
        if bpy.app.background:
            source.user_remap(stage)
        yield stage
    finally:
        if bpy.app.background:
            stage.user_remap(source)
        bpy.data.scenes.remove(stage)
        if bpy.app.background:
            source.frame_set(source.frame_current, subframe=source.frame_subframe)


def simulate(last: int) -> None:
    """Plays the open scene up to scene frame `last` where something is simulated and not baked: physics goes from frame
    to frame and stands still where one jumps. Rigid bodies become keyframes, for they move in no copy of their scene;
    call it only where the session is thrown away."""
    scene = bpy.context.scene
    caches = []
    for ob in bpy.data.objects:
        caches += [m.point_cache for m in ob.modifiers if m.type in ("CLOTH", "SOFT_BODY")]
        caches += [p.point_cache for p in ob.particle_systems]
    first = [c.frame_start for c in caches if not c.is_baked]
    if any(n.bl_idname == "GeometryNodeSimulationOutput" for g in bpy.data.node_groups for n in g.nodes):
        first.append(scene.frame_start)
    for frame in range(min(first), last + 1) if first else ():
        scene.frame_set(frame)
    if scene.rigidbody_world:
        _key_rigid_bodies(scene, last)


def _key_rigid_bodies(scene, last: int) -> None:
    frames = range(scene.rigidbody_world.point_cache.frame_start, last + 2)  # motion vectors look one ahead
    bodies = [ob for ob in scene.objects if ob.rigid_body and ob.rigid_body.type == "ACTIVE"]
    poses = []
    for frame in frames:
        scene.frame_set(frame)
        poses.append([ob.matrix_world.copy() for ob in bodies])
    bpy.ops.rigidbody.world_remove()
    for ob in bodies:
        ob.rotation_mode = "QUATERNION"
    for frame, there in zip(frames, poses, strict=True):
        scene.frame_set(frame)
        for ob, pose in zip(bodies, there, strict=True):
            ob.matrix_world = pose
            ob.keyframe_insert("location", frame=frame)
            ob.keyframe_insert("rotation_quaternion", frame=frame)


# ---------------------------------------------------------------- measuring


def vertices(mesh) -> np.ndarray:
    """(N,3) float64 local coordinates of a mesh."""
    return _floats(mesh.vertices, "co")


def _floats(items, name: str) -> np.ndarray:
    flat = np.empty(len(items) * 3, np.float32)
    items.foreach_get(name, flat)
    return flat.reshape(-1, 3).astype(np.float64)


def _points(ob) -> np.ndarray:
    """(N,3) local coordinates of what an evaluated object shows; none for a kind that shows nothing."""
    if ob.type == "MESH":
        return vertices(ob.data)
    if ob.type in ("CURVES", "POINTCLOUD") and (position := ob.data.attributes.get("position")):
        return _floats(position.data, "vector")
    return np.array(ob.bound_box if ob.type == "VOLUME" else [], float).reshape(-1, 3)


def world_vertices(depsgraph) -> list[tuple[str, np.ndarray]]:
    """(object name, (N,3) world coordinates) of each instance of a shape that an evaluated scene shows to cameras."""
    found = []
    for instance in depsgraph.object_instances:
        ob, top = instance.object, instance.parent or instance.object
        if top.hide_render or not (instance.show_self and ob.visible_camera and top.visible_camera):
            continue
        points, matrix = _points(ob), np.array(instance.matrix_world)
        if len(points):
            found.append((ob.name, points @ matrix[:3, :3].T + matrix[:3, 3]))
    return found


class _Ruler(bpy.types.RenderEngine):
    """Measures instead of rendering: only a render engine is shown what renders show, with their modifiers, levels
    and visibility."""

    bl_idname, bl_label = "TIMESPLAT_RULER", "Timesplat"
    found: ClassVar[list] = []

    def render(self, depsgraph) -> None:
        try:
            _Ruler.found.append(world_vertices(depsgraph))
        except Exception as e:  # Blender would print it and go on
            _Ruler.found.append(e)


def measured(frames: list[int], objects: list | None = None, *, rendered: bool = True) -> Iterator[list]:
    """`world_vertices` at each of the scene frames, as renders show them, which replaces the session's render result;
    rendered False: as the viewport does."""
    with borrowed(objects) as stage, contextlib.ExitStack() as stack:
        render, layer = stage.render, stage.view_layers[0]
        if rendered:
            bpy.utils.register_class(_Ruler)
            stack.callback(bpy.utils.unregister_class, _Ruler)
            stage.camera = bpy.data.objects.new("timesplat", bpy.data.cameras.new("timesplat"))  # one must be there
            stack.callback(bpy.data.batch_remove, [stage.camera.data, stage.camera])
            render.engine, render.resolution_x, render.resolution_y = _Ruler.bl_idname, 8, 8
            render.use_compositing = render.use_sequencer = render.use_multiview = render.use_freestyle = False
            render.use_stamp, layer.use = False, True
        else:
            for ob in layer.objects:
                ob.hide_set(False, view_layer=layer)
                stack.callback(setattr, ob, "hide_viewport", ob.hide_viewport)
                ob.hide_viewport = False
        for frame in dict.fromkeys(frames):
            stage.frame_set(frame)
            if not rendered:
                yield world_vertices(layer.depsgraph)
                continue
            with bpy.context.temp_override(scene=stage):
                bpy.ops.render.render()
            found = _Ruler.found.pop()
            if isinstance(found, Exception):
                raise found
            yield found


def normalisation(
    frames: list[int], objects: list | None = None, name: str = "scene", *, rendered: bool = True
) -> tuple[Normalisation, np.ndarray]:
    """Bounds of the visible shapes of the open scene over all scene frames given: the Normalisation (box
    centre, longest half-side) and the box itself, (2,3), in normalised units; `rendered` as `measured` has it.
    Raises InputError (with `name`) where nothing is visible, a vertex is not finite or too far out, or everything
    is one point."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for found in measured(frames, objects, rendered=rendered):
        for part, points in found:
            check_vertices(name, part, points)
            low, high = np.minimum(low, points.min(0)), np.maximum(high, points.max(0))
    if not np.isfinite(low).all():
        where = f"frames {frames[0]} to {frames[-1]}"
        raise InputError(f"{name}: no mesh is visible to renders in {where}; show it there, or choose others.")
    centre, scale = (low + high) / 2, float((high - low).max() / 2)
    if not scale > 1e-9:
        raise InputError(f"{name}: all vertices lie at one point; give an object that has a size.")
    norm = Normalisation(scale, tuple(float(x) for x in centre))
    return norm, np.stack([low - centre, high - centre]) / scale


def motion(frames: list[int], objects: list | None = None) -> float:
    """How much moves: the mean over all vertices of the largest distance from where they were at the first
    of the frames, in units of the longest half-side of the box over those frames; 0 for what holds still.
    Meshes whose vertex count changes are left out."""
    tracks: dict[int, list[np.ndarray]] = {}
    for found in measured(frames, objects):
        for i, (_, points) in enumerate(found):
            tracks.setdefault(i, []).append(points)
    whole = [t for t in tracks.values() if all(len(p) == len(t[0]) for p in t)]
    if not whole:
        return 0.0
    low = np.min([p.min(0) for t in whole for p in t], 0)
    high = np.max([p.max(0) for t in whole for p in t], 0)
    moved = np.concatenate([np.max([np.linalg.norm(p - t[0], axis=1) for p in t], 0) for t in whole])
    return float(moved.mean() / max((high - low).max() / 2, 1e-9))


def most_moving(asset: Asset, count: int = 24) -> Clip:
    """The clip in whose first `count` frames the vertices move most, judged by six of them."""
    if len(asset.clips) == 1:
        return asset.clips[0]

    def moves(clip: Clip) -> float:
        asset.play(clip)
        frames = clip.frames(count)
        return motion([frames[round(i * (len(frames) - 1) / 5)] for i in range(6)])

    return max(asset.clips, key=moves)
