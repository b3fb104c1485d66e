# SPDX-License-Identifier: GPL-3.0-or-later
"""The paths of a tracked asset in Blender: a mesh of their knots, and what each Gaussian knows of the one it rides on.

The mesh belongs to an object `<name> Paths` that no scene shows: the modifier's input `Paths` names it, and so it is
saved, appended and linked along. Its vertices are the knots, those of one path after another, with the attribute
    gs_turn                                        the frame of reference's rotation at the knot
and each Gaussian has, beside what display.py says,
    gs_path_first, gs_path_knots                   its path's first knot, and how many there are
    gs_path_start, gs_path_end                     model times of the first and last one: it is there between them
    gs_offset, gs_row_0..2, rotation               place, rows of (R S)⁻¹ and rotation IN the moving frame
"""

from __future__ import annotations

from dataclasses import replace

import bpy
import numpy as np

from ...datagen.sequence import InputError
from ...model.io.asset import Asset
from ...model.io.paths import Paths
from .attributes import read_attribute, write_attributes
from .sliders import asset_modifier, get_input

MAX_KNOTS = 1 << 24  # nodes count them in single precision


def knots_object(paths: Paths, name: str):
    """A new object with the knots, in no collection. Raises InputError if there are more than MAX_KNOTS."""
    if len(paths.place) > MAX_KNOTS:
        raise InputError(f"{name}: its paths have {len(paths.place):,} knots, too many for Blender; make it shorter.")
    mesh = bpy.data.meshes.new(f"{name} Paths")
    mesh.vertices.add(len(paths.place))
    write_attributes(mesh, [("position", "FLOAT_VECTOR", paths.place), ("gs_turn", "QUATERNION", paths.rotation)])
    ob = bpy.data.objects.new(mesh.name, mesh)
    ob.hide_viewport = ob.hide_render = ob.hide_select = True  # File > Append puts it into the scene
    ob["timesplat"] = 1  # captures leave it out
    return ob


def track_attributes(asset: Asset, offset: np.ndarray) -> list[tuple]:
    """(name, kind, array of N rows) of what a Gaussian knows of its path; `offset` (N,3) as `Asset.on_path` has it."""
    p, row = asset.paths, asset.path
    return [
        ("gs_path_first", "INT", p.first[row]),
        ("gs_path_knots", "INT", p.count[row]),
        ("gs_path_start", "FLOAT", p.start[row]),
        ("gs_path_end", "FLOAT", p.end[row]),
        ("gs_offset", "FLOAT_VECTOR", offset),
    ]


def is_tracked(ob) -> bool:
    """Whether the Gaussians of an asset object ride on paths."""
    return "gs_path_first" in ob.data.attributes


def read_paths(ob) -> dict:
    """`path` and `paths` of an Asset, those that something rides on in the order of their knots; nothing where the
    Gaussians do not. Raises InputError where the knots are gone, KeyError where an attribute is."""
    if not is_tracked(ob):
        return {}
    first, at, path = np.unique(read_attribute(ob.data, "gs_path_first"), return_index=True, return_inverse=True)
    count, start, end = (read_attribute(ob.data, f"gs_path_{x}")[at] for x in ("knots", "start", "end"))
    knots = get_input(asset_modifier(ob), "Paths")
    size = len(knots.data.vertices) if knots and knots.type == "MESH" else 0
    if first[0] < 0 or (first + count).max() > size:
        raise InputError(f"{ob.name}: the paths that its Gaussians ride on are gone; import it again.")
    rows = np.repeat(first - (np.cumsum(count) - count), count) + np.arange(count.sum())
    place, turn = (read_attribute(knots.data, name)[rows] for name in ("position", "gs_turn"))
    return {"path": path.astype(np.int32).reshape(-1), "paths": Paths(start, end, count, place, turn)}


def retimed(paths: Paths, a: float, b: float) -> Paths:
    """The same paths where model time is `a` (not 0) times the new one plus `b`; backwards for a negative one."""
    start, end = (((x.astype(np.float64) - b) / a).astype(np.float32) for x in (paths.start, paths.end))
    if a > 0:
        return replace(paths, start=start, end=end)
    rows = np.repeat(2 * paths.first + paths.count - 1, paths.count) - np.arange(len(paths.place))
    return replace(paths, start=end, end=start, place=paths.place[rows], rotation=paths.rotation[rows])
