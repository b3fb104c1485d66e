# SPDX-License-Identifier: GPL-3.0-or-later
"""Paths as the two tables that follow the Gaussians in a .ply: `element path` and `element knot`. numpy only, for
inside Blender.

A path has start, end (model times), knots (how many), and x y z size: the box in which its knots are. A knot has
x y z and rot_0..3 (w x y z) in 16 bits: 32767 is `size` away from the box's middle, or 1 of a quaternion. So a place is
right to size/65534, which is below 2e-5 for paths shorter than 2.6 (the object is 2 wide), and what stands still is
exact; a rotation is right to 7e-5 radians.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...datagen.sequence import InputError
from .paths import Paths, continuous

PATH = {"start": "<f4", "end": "<f4", "knots": "<i4", "x": "<f4", "y": "<f4", "z": "<f4", "size": "<f4"}
KNOT = dict.fromkeys(("x", "y", "z", "rot_0", "rot_1", "rot_2", "rot_3"), "<i2")
STEPS = 32767  # of a 16-bit number


def path_tables(paths: Paths) -> dict[str, np.ndarray]:
    """{"path": (P,) of PATH, "knot": (M,) of KNOT}."""
    place, first = paths.place.astype(np.float64), paths.first
    low, high = (f.reduceat(place, first) for f in (np.minimum, np.maximum))
    rows, knots = (np.empty(n, list(kind.items())) for n, kind in ((len(paths), PATH), (len(place), KNOT)))
    rows["start"], rows["end"], rows["knots"] = paths.start, paths.end, paths.count
    rows["x"], rows["y"], rows["z"] = ((low + high) / 2).T
    middle = np.stack([rows[a] for a in "xyz"], 1).astype(np.float64)  # as it is stored
    rows["size"] = np.maximum(high - middle, middle - low).max(1)
    size = np.repeat(np.maximum(rows["size"], np.float32(1e-30)).astype(np.float64), paths.count)
    steps = np.concatenate([(place - np.repeat(middle, paths.count, 0)) / size[:, None], paths.rotation], 1) * STEPS
    for name, column in zip(KNOT, np.round(steps).clip(-STEPS, STEPS).T, strict=True):
        knots[name] = column
    return {"path": rows, "knot": knots}


def paths_from_tables(rows: np.ndarray, knots: np.ndarray, source: str | Path) -> Paths:
    """What `path_tables` made tables of, from arrays with these fields of any type. Raises InputError where the knots
    are not those of the paths; values are for `asset.check` to judge."""
    for table, kind, element in ((rows, PATH, "path"), (knots, KNOT, "knot")):
        if lost := [name for name in kind if name not in table.dtype.fields]:
            raise InputError(f"{source}: its element {element} lacks {lost[0]}; export it again from Timesplat.")
    told = rows["knots"].astype(np.float64)
    if not ((told >= 1) & (told <= len(knots))).all() or told.sum() != len(knots):
        raise InputError(f"{source}: its {len(knots)} knots are not those that its paths count; export it again.")
    count = told.astype(np.int32)
    with np.errstate(over="ignore", invalid="ignore"):
        steps = np.stack([knots[name] for name in KNOT], 1) / np.float64(STEPS)
        middle, size = (np.stack([rows[a] for a in names], 1).astype(np.float64) for names in ("xyz", ("size",)))
        place = np.repeat(middle, count, 0) + np.repeat(size, count, 0) * steps[:, :3]
        length = np.linalg.norm(steps[:, 3:], axis=1, keepdims=True)
        turn = np.where(length > 0, steps[:, 3:] / np.maximum(length, 1e-300), [1.0, 0, 0, 0])
        start, end, place, turn = (a.astype(np.float32) for a in (rows["start"], rows["end"], place, turn))
    return Paths(start, end, count, place, continuous(turn, count))
