# SPDX-License-Identifier: GPL-3.0-or-later
"""Measures what the open scene shows: its vertices in the world, the box around them, and how much they move."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import bpy
import numpy as np

from ..rigs import RADIUS
from ..sequence import InputError, Normalisation
from .borrow import borrowed
from .gltf import LARGEST_COORDINATE

T = TypeVar("T")
_STILL = 1e-6  # of the largest coordinate: what single precision rounds


def check_vertices(path: Path | str, name: str, points: np.ndarray) -> None:
    """InputError unless all coordinates of the mesh `name`, (N,3), are finite and within LARGEST_COORDINATE."""
    if points.size and not np.abs(points).max() <= LARGEST_COORDINATE:
        raise InputError(
            f"{path}: the mesh {name} has vertices that are not finite or beyond {LARGEST_COORDINATE:.0e}; repair it."
        )


def mesh_vertices(mesh) -> np.ndarray:
    """(N,3) float64 local coordinates of a mesh."""
    return _coordinates(mesh.vertices, "co")


def _coordinates(items, attribute: str) -> np.ndarray:
    """(N,3) float64: an attribute of three numbers of each item of a Blender collection."""
    flat = np.empty(len(items) * 3, np.float32)
    items.foreach_get(attribute, flat)
    return flat.reshape(-1, 3).astype(np.float64)


def _face_vertices(mesh) -> np.ndarray:
    """(N,3) float64 local coordinates of the vertices that faces have: loose ones and edges show in no render."""
    if not len(mesh.polygons):
        return np.empty((0, 3))
    corners, used = mesh.attributes[".corner_vert"].data, np.zeros(len(mesh.vertices), bool)
    indices = np.empty(len(corners), np.int32)
    corners.foreach_get("value", indices)
    used[indices] = True
    return mesh_vertices(mesh)[used]


def _local_points(ob) -> np.ndarray:
    """(N,3) local coordinates of what an evaluated object shows; none for a kind that shows nothing."""
    if ob.type == "MESH":
        return _face_vertices(ob.data)
    if ob.type in ("CURVES", "POINTCLOUD") and (position := ob.data.attributes.get("position")):
        return _coordinates(position.data, "vector")
    return np.array(ob.bound_box if ob.type == "VOLUME" else [], float).reshape(-1, 3)


def shown_instances(depsgraph) -> Iterator:
    """The instances that an evaluated scene shows to cameras. Each is gone when the next one comes."""
    for instance in depsgraph.object_instances:
        ob, top = instance.object, instance.parent or instance.object
        if not top.hide_render and instance.show_self and ob.visible_camera and top.visible_camera:
            yield instance


def world_vertices(depsgraph) -> list[tuple[str, np.ndarray]]:
    """(object name, (N,3) float64 world coordinates) of each instance of a shape that an evaluated scene shows to
    cameras."""
    found = []
    for instance in shown_instances(depsgraph):
        ob = instance.object
        points, matrix = _local_points(ob), np.array(instance.matrix_world)
        if len(points):
            found.append((ob.name, points @ matrix[:3, :3].T + matrix[:3, 3]))
    return found


class _MeasuringEngine(bpy.types.RenderEngine):
    """Measures instead of rendering: only a render engine is shown what renders show, with their modifiers, levels
    and visibility."""

    bl_idname, bl_label = "TIMESPLAT_MEASURE", "Timesplat"
    measure: ClassVar[list] = []  # its last is the function that is given the evaluated scene
    results: ClassVar[list] = []  # of each render: what that returned, or the exception

    def render(self, depsgraph) -> None:
        try:
            self.results.append(self.measure[-1](depsgraph))
        except Exception as e:  # Blender would print it and go on
            self.results.append(e)


def vertices_at(frames: list[int], objects: list | None = None, *, rendered: bool = True) -> Iterator[list]:
    """`world_vertices` at each of the scene frames, as renders show them, which replaces the session's render result;
    rendered False: as the viewport does."""
    if rendered:
        yield from as_rendered(frames, world_vertices, objects)
        return
    with borrowed(objects) as stage, contextlib.ExitStack() as cleanup:
        _show_in_viewport(stage.view_layers[0], cleanup)
        for frame in dict.fromkeys(frames):
            stage.frame_set(frame)
            yield world_vertices(stage.view_layers[0].depsgraph)


def as_rendered(frames: Sequence[float], measure: Callable[[Any], T], objects: list | None = None) -> Iterator[T]:
    """What `measure` makes of the evaluated scene (a depsgraph) as renders show it, once at each of the scene frames,
    whole or not. Replaces the session's render result."""
    with borrowed(objects) as stage, contextlib.ExitStack() as cleanup:
        _prepare_measuring_render(stage, cleanup)
        for frame in dict.fromkeys(frames):
            whole = math.floor(frame)
            stage.frame_set(whole, subframe=frame - whole)
            yield _measured(stage, measure)


def _prepare_measuring_render(stage, cleanup: contextlib.ExitStack) -> None:
    """Sets the borrowed scene to be rendered by the measuring engine, as fast as can be."""
    bpy.utils.register_class(_MeasuringEngine)
    cleanup.callback(bpy.utils.unregister_class, _MeasuringEngine)
    stage.camera = bpy.data.objects.new("timesplat", bpy.data.cameras.new("timesplat"))  # one must be there
    cleanup.callback(bpy.data.batch_remove, [stage.camera.data, stage.camera])
    render = stage.render
    render.engine, render.resolution_x, render.resolution_y = _MeasuringEngine.bl_idname, 8, 8
    render.use_compositing = render.use_sequencer = render.use_multiview = render.use_freestyle = False
    render.use_stamp, stage.view_layers[0].use = False, True


def _measured(stage, measure: Callable[[Any], T]) -> T:
    _MeasuringEngine.measure.append(measure)
    try:
        with bpy.context.temp_override(scene=stage):
            bpy.ops.render.render()
    finally:
        _MeasuringEngine.measure.pop()
    result = _MeasuringEngine.results.pop()
    if isinstance(result, Exception):
        raise result
    return result


def _show_in_viewport(layer, cleanup: contextlib.ExitStack) -> None:
    """Evaluation leaves out what is hidden in the viewport: shows all of it, until the cleanup."""
    for ob in layer.objects:
        ob.hide_set(False, view_layer=layer)
        cleanup.callback(setattr, ob, "hide_viewport", ob.hide_viewport)
        ob.hide_viewport = False


def normalisation(
    frames: list[int], objects: list | None = None, name: str = "scene", *, rendered: bool = True
) -> tuple[Normalisation, np.ndarray]:
    """Bounds of the visible shapes of the open scene over all scene frames given: the Normalisation and the box, (2,3),
    in normalised units: its centre is the origin, its longest half-side at most 1, and no vertex farther from the
    origin than RADIUS, which every camera of our rigs sees whole. `rendered` as `vertices_at` has it.
    Raises InputError (with `name`) where nothing is visible, a vertex is not finite or too far out, or everything
    is one point."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for found in vertices_at(frames, objects, rendered=rendered):
        for part, points in found:
            check_vertices(name, part, points)
            low, high = np.minimum(low, points.min(0)), np.maximum(high, points.max(0))
    if not np.isfinite(low).all():
        where = f"frames {frames[0]:g} to {frames[-1]:g}"
        if any(len(mesh.vertices) and not len(mesh.polygons) for mesh in bpy.data.meshes):
            raise InputError(f"{name}: what is visible in {where} has points and edges alone; give it faces.")
        raise InputError(f"{name}: no mesh is visible to renders in {where}; show it there, or choose others.")
    centre, scale = (low + high) / 2, float((high - low).max() / 2)
    if not scale > max(1e-20, _STILL * np.abs(centre).max()):
        raise InputError(f"{name}: all vertices lie at one point; give an object that has a size.")
    diagonal = float(np.linalg.norm(high - low)) / 2
    if diagonal > RADIUS * scale:  # else no corner is as far
        found = (points for parts in vertices_at(frames, objects, rendered=rendered) for _, points in parts)
        scale = max(scale, max(float(np.linalg.norm(points - centre, axis=1).max()) for points in found) / RADIUS)
    norm = Normalisation(scale, tuple(float(x) for x in centre))
    return norm, np.stack([low - centre, high - centre]) / scale


def motion(frames: list[int], objects: list | None = None) -> float:
    """How much moves: the mean over all vertices of the largest distance from where they were at the first
    of the frames, in units of the longest half-side of the box over those frames; 0 for what holds still.
    Meshes whose vertex count changes are left out."""
    tracks: dict[int, list[np.ndarray]] = {}
    for found in vertices_at(frames, objects):
        for i, (_, points) in enumerate(found):
            tracks.setdefault(i, []).append(points)
    whole = [t for t in tracks.values() if all(len(p) == len(t[0]) for p in t)]
    if not whole:
        return 0.0
    low = np.min([p.min(0) for t in whole for p in t], 0)
    high = np.max([p.max(0) for t in whole for p in t], 0)
    moved = np.concatenate([np.max([np.linalg.norm(p - t[0], axis=1) for p in t], 0) for t in whole])
    return float(moved.mean() / max((high - low).max() / 2, 1e-9))


def holds_still(frames: Sequence[float]) -> bool:
    """Whether no vertex of the open scene moves in these frames, nor appears or vanishes; looks no further than where
    one does."""
    first: list | None = None
    for found in as_rendered(frames, world_vertices):
        if first is None:
            first = found
        elif len(found) != len(first):
            return False
        else:
            for (_, points), (_, before) in zip(found, first, strict=True):
                if points.shape != before.shape or np.abs(points - before).max() > _STILL * np.abs(before).max():
                    return False
    return True
