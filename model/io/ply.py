# SPDX-License-Identifier: GPL-3.0-or-later
"""The asset's own file: a 3D Gaussian Splatting .ply with motion and lifetimes. numpy only, for inside Blender.

It is a binary little-endian PLY with the property names of 3D Gaussian Splatting, so that viewers of those show it
(every Gaussian at its own time), followed by t, scale_t, vx, vy, vz. Two things are left out: normals, which no splat
viewer uses, and f_rest_*, because the colour does not depend on the direction. Clip metadata stands in
`comment timesplat <key> <value>` lines. See `write_ply` for the units.

Where there are paths, each Gaussian has one more property, `path` (a float like all others, for readers that take them
for granted), and the elements path and knot follow (see ply_paths.py). Such a file is of version 2, because a reader of
version 1 would pass over them and see straight lines without end.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...datagen.sequence import InputError
from .asset import ARRAYS, SH_C0, STATIC_SIGMA_T, Asset, Clip, check
from .atomic import atomic_write
from .ply_paths import path_tables, paths_from_tables

POSITION, COLOUR, SCALE = ("x", "y", "z"), ("f_dc_0", "f_dc_1", "f_dc_2"), ("scale_0", "scale_1", "scale_2")
ROTATION, VELOCITY = ("rot_0", "rot_1", "rot_2", "rot_3"), ("vx", "vy", "vz")
PROPERTIES_3DGS = (*POSITION, *COLOUR, "opacity", *SCALE, *ROTATION)
PROPERTIES_4D = ("t", "scale_t", *VELOCITY)

OPACITY_MARGIN = 1e-6  # opacities are kept this far from 0 and 1, because they are written as logits
FORMAT_VERSION = 2  # that can be read; what has no paths is written as version 1
MAX_HEADER_BYTES = 1 << 16
_NUMPY_TYPES = {
    **{"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2"},
    **{"ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}
_PLY_TYPES = {"<f4": "float", "<i4": "int", "<i2": "short"}
_CONTENTS = {"vertex": "Gaussians", "path": "paths", "knot": "knots"}


# ---------------------------------------------------------------- writing


def write_ply(path: str | Path, asset: Asset) -> None:
    """Writes the asset; the file appears whole or not at all. Raises InputError (see `check`).

    Positions and velocities are in normalised units (per unit of model time), f_dc = (rgb - 0.5)/SH_C0,
    opacity is a logit, scale_* and scale_t are natural logs, rot_* is w x y z. Reading gives the same
    values back to float32 precision (a relative 1e-6), except that opacities nearer than 1e-6 to 0 or 1
    are moved to that distance, and that paths are rounded (see ply_paths.py). The velocity of what rides on a path is
    written as the path has it at the Gaussian's own time."""
    check(asset, path)
    data = asset_bytes(asset)
    with atomic_write(path) as tmp:
        tmp.write_bytes(data)


def asset_bytes(asset: Asset) -> bytes:
    """What `write_ply` writes."""
    tables = {} if asset.paths is None else path_tables(asset.paths)
    if tables:
        asset = replace(asset, velocity=asset.path_velocity())
    exact = replace(asset, **{name: getattr(asset, name).astype(np.float64) for name in ARRAYS})
    columns = columns_3dgs(exact) | {"t": exact.t, "scale_t": np.log(exact.sigma_t)}
    columns |= dict(zip(VELOCITY, exact.velocity.T, strict=True))
    if tables:
        columns["path"] = asset.path
    comments = [f"timesplat {key} {value}" for key, value in _metadata(asset.clip, 2 if tables else 1)]
    return ply_bytes(columns, comments, **tables)


def columns_3dgs(asset: Asset) -> dict[str, np.ndarray]:
    """The PROPERTIES_3DGS of the asset's Gaussians, (N,) each, computed in the precision of its arrays."""
    opacity = np.clip(asset.opacity.astype(np.float64), OPACITY_MARGIN, 1 - OPACITY_MARGIN)
    return {
        **dict(zip(POSITION, asset.xyz.T, strict=True)),
        **dict(zip(COLOUR, ((asset.rgb - 0.5) / SH_C0).T, strict=True)),
        "opacity": np.log(opacity / (1 - opacity)),
        **dict(zip(SCALE, np.log(asset.scale).T, strict=True)),
        **dict(zip(ROTATION, asset.rotation.T, strict=True)),
    }


def ply_bytes(columns: dict[str, np.ndarray], comments: list[str], **tables: np.ndarray) -> bytes:
    """A whole binary .ply with a float property for each of the columns (N,), in their order, and after these an
    element for each of the `tables`, record arrays of _PLY_TYPES."""
    rows = np.rec.fromarrays(list(columns.values()), [(name, "<f4") for name in columns])
    header, data = ["ply", "format binary_little_endian 1.0", *(f"comment {c}" for c in comments)], []
    for element, table in {"vertex": rows, **tables}.items():
        header.append(f"element {element} {len(table)}")
        header += [f"property {_PLY_TYPES[kind]} {name}" for name, kind in table.dtype.descr]
        data.append(table.tobytes())
    return b"".join(["\n".join([*header, "end_header", ""]).encode("ascii"), *data])


def _metadata(clip: Clip, version: int) -> list[tuple[str, object]]:
    """What the comments say, by key; `_clip` reads it."""
    return [
        ("version", version),
        ("fps", float(clip.fps)),
        ("frame_start", clip.frame_start),
        ("frame_end", clip.frame_end),
        ("scale", float(clip.scale)),
        ("translation", " ".join(repr(float(x)) for x in clip.translation)),
        ("colour_space", "sRGB"),
        ("pixel", float(clip.pixel)),
    ]


# ---------------------------------------------------------------- reading


def read_ply(path: str | Path) -> Asset:
    """Reads what `write_ply` wrote, or any uncompressed binary 3DGS .ply: without the time columns it is a
    static asset (v = 0, t = 0, sigma_t = STATIC_SIGMA_T), without comments the clip is Clip(). Unknown
    properties (normals, f_rest_*) are passed over; quaternions are normalised, zero ones become the
    identity. Raises InputError: one sentence with the file, what is wrong and what to do."""
    path = Path(path)
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; check the name.") from None
    except OSError as e:
        raise InputError(f"{path}: it cannot be read ({e.strerror or e}); check the file.") from None
    return asset_from_bytes(data, path)


def asset_from_bytes(data: bytes, path: Path) -> Asset:
    """`read_ply` of what is in memory; the path is for errors."""
    tables, meta = _read_tables(data, path)
    rows = tables["vertex"]
    moves = _is_4d(rows.dtype.names, path)
    count = len(rows)

    def get(*properties: str) -> np.ndarray:
        """(N,k), or (N,) of one property."""
        out = np.stack([rows[p] for p in properties], -1).astype(np.float64)
        wrong = ~np.isfinite(out)
        if wrong.any():
            prop = properties[int(wrong.any(0).argmax())]
            raise InputError(
                f"{path}: {prop} holds NaN or infinity in {wrong.any(1).sum()} of {count} Gaussians; "
                "remove those Gaussians or export the file again."
            )
        return out if len(properties) > 1 else out.squeeze(1)

    with np.errstate(over="ignore", invalid="ignore"):  # what overflows is refused by `check`
        quaternion = get(*ROTATION)
        length = np.linalg.norm(quaternion, axis=1, keepdims=True)
        quaternion = np.where(length > 0, quaternion / np.maximum(length, 1e-300), [1.0, 0, 0, 0])
        arrays = {
            "xyz": get(*POSITION),
            "t": get("t") if moves else np.zeros(count),
            "velocity": get(*VELOCITY) if moves else np.zeros((count, 3)),
            "sigma_t": np.exp(get("scale_t")) if moves else np.full(count, STATIC_SIGMA_T),
            "scale": np.exp(get(*SCALE)),
            "rotation": quaternion,
            "rgb": 0.5 + SH_C0 * get(*COLOUR),
            "opacity": 1 / (1 + np.exp(-get("opacity"))),
        }
        asset = Asset(**{k: a.astype(np.float32) for k, a in arrays.items()}, clip=_clip(meta, path))
    if "path" in tables:
        paths, index = paths_from_tables(tables["path"], tables["knot"], path), get("path")
        if not ((index >= 0) & (index < len(paths)) & (index == np.floor(index))).all():
            raise InputError(f"{path}: it has Gaussians on paths that are not there; export it again.")
        asset = replace(asset, path=index.astype(np.int32), paths=paths)
    check(asset, path)
    return asset


def _read_tables(data: bytes, path: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """-> the vertices as a record array, and the paths and knots where the vertices are on some; and the
    `comment timesplat` values."""
    tables = {}
    elements, meta, at = _header(data[:MAX_HEADER_BYTES], path)
    for name, (dtype, count) in elements.items():
        have = max(len(data) - at, 0)
        if have < count * dtype.itemsize:
            raise InputError(
                f"{path}: the file is truncated, {count} {_CONTENTS[name]} were announced and there is data "
                f"for {have // dtype.itemsize}; copy or export it again."
            )
        tables[name] = np.frombuffer(data, dtype, count, at)
        at += count * dtype.itemsize
    return tables, meta


def _is_4d(names: tuple[str, ...], path: Path) -> bool:
    """Whether the properties of time are there. Raises InputError if some of them are not, or those of a splat."""
    if missing := [p for p in PROPERTIES_3DGS if p not in names]:
        hint = "it is a compressed splat file" if "packed_position" in names else "it is not a Gaussian splat"
        raise InputError(
            f"{path}: the property {missing[0]} is missing, {hint}; export it as an uncompressed 3DGS .ply."
        )
    found = [p for p in PROPERTIES_4D if p in names]
    if found and len(found) < len(PROPERTIES_4D):
        lost = next(p for p in PROPERTIES_4D if p not in names)
        raise InputError(f"{path}: it has {found[0]} but lacks {lost}; export it again from Timesplat.")
    return bool(found)


def _header(head: bytes, path: Path) -> tuple[dict[str, tuple[np.dtype, int]], dict[str, str], int]:
    """-> row dtype and number of rows of the elements that count, `comment timesplat` values, where the data begins."""
    if not re.match(rb"ply\r?\n", head):
        raise InputError(f"{path}: it is not a .ply file; choose a Gaussian splat .ply.")
    end = re.search(rb"\nend_header\r?\n", head)
    if end is None:
        raise InputError(f"{path}: the header has no end, the file is truncated; copy or export it again.")
    order, meta = "", {}
    elements: list[tuple[str, int, list[tuple[str, str]]]] = []  # name, count, (name, type) of the properties
    try:
        for line in head[: end.start()].decode("utf-8", "replace").splitlines()[1:]:
            word = line.split()
            if word[:1] == ["format"]:
                order = {"binary_little_endian": "<", "binary_big_endian": ">"}.get(word[1], "")
                if not order:
                    raise InputError(f"{path}: its format is {word[1]}; convert it to a binary .ply.")
            elif word[:2] == ["comment", "timesplat"]:
                meta[word[2]] = " ".join(word[3:])
            elif word[:1] == ["element"]:
                elements.append((word[1], int(word[2]), []))
            elif word[:1] == ["property"]:
                elements[-1][2].append((word[2], word[1]))
        if not elements or elements[0][0] != "vertex":
            first = elements[0][0] if elements else "nothing"
            raise InputError(
                f"{path}: its first element is {first}, not vertex; export it as an uncompressed 3DGS .ply."
            )
        if not order:
            raise ValueError("it names no format")
        on_paths = "path" in dict(elements[0][2])
        if on_paths and [name for name, *_ in elements[1:3]] != ["path", "knot"]:
            raise InputError(f"{path}: its Gaussians are on paths that it lacks; export it again from Timesplat.")
        found = {}
        for name, count, properties in elements[: 3 if on_paths else 1]:
            if count < 0 or not properties:
                raise ValueError(f"no {_CONTENTS[name]}")
            found[name] = np.dtype([(prop, order + _NUMPY_TYPES[kind]) for prop, kind in properties]), count
        return found, meta, end.end()
    except InputError:
        raise
    except (ValueError, KeyError, IndexError, TypeError) as e:
        raise InputError(f"{path}: the header is damaged ({e}); copy or export it again.") from None


def _clip(meta: dict[str, str], path: Path) -> Clip:
    if not meta:
        return Clip()
    try:
        if int(meta["version"]) > FORMAT_VERSION:
            raise InputError(f"{path}: it was written by a newer Timesplat; update yours.")
        x, y, z = (float(v) for v in meta["translation"].split())
        return Clip(
            fps=float(meta["fps"]),
            frame_start=int(meta["frame_start"]),
            frame_end=int(meta["frame_end"]),
            scale=float(meta["scale"]),
            translation=(x, y, z),
            pixel=float(meta.get("pixel", 0)),
        )
    except InputError:
        raise
    except (KeyError, ValueError) as e:
        raise InputError(f"{path}: the clip's comments are damaged ({e}); export it again.") from None
