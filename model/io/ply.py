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

from dataclasses import replace
from pathlib import Path

import numpy as np

from ...datagen.sequence import InputError
from .asset import ARRAYS, SH_C0, SMALLEST_SCALE, STATIC_SIGMA_T, Asset, Clip, check, near_origin, sound_part
from .atomic import atomic_write
from .ply_paths import path_tables, paths_from_tables
from .ply_tables import PlyTables

POSITION, COLOUR, SCALE = ("x", "y", "z"), ("f_dc_0", "f_dc_1", "f_dc_2"), ("scale_0", "scale_1", "scale_2")
ROTATION, VELOCITY = ("rot_0", "rot_1", "rot_2", "rot_3"), ("vx", "vy", "vz")
PROPERTIES_3DGS = (*POSITION, *COLOUR, "opacity", *SCALE, *ROTATION)
PROPERTIES_4D = ("t", "scale_t", *VELOCITY)

OPACITY_MARGIN = 1e-6  # opacities are kept this far from 0 and 1, because they are written as logits
FORMAT_VERSION = 2  # that can be read; what has no paths is written as version 1
PLAIN_COLOUR = ("red", "green", "blue")  # of other programs, in place of COLOUR
FLAT_SCALE, FLATNESS = "scale_2", 1e-3  # what discs lack, and how thick they are by their shorter side
_PLY_TYPES = {"<f4": "float", "<i4": "int", "<i2": "short"}


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
    """Reads what `write_ply` wrote, or any uncompressed .ply of Gaussians, binary or ascii: without the time columns it
    is a static asset (v = 0, t = 0, sigma_t = STATIC_SIGMA_T), without comments the clip is Clip(), but for what is far
    from the origin (see `asset.near_origin`). Discs without a third scale (2DGS) are flat Gaussians; red, green, blue
    in place of f_dc_* are colours. Unknown properties (normals, f_rest_*) are passed over; quaternions are normalised,
    zero ones become the identity. Raises InputError: one sentence with the file, what is wrong and what to do."""
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
    tables = PlyTables(data, path)
    rows = tables.table("vertex")
    for name in (*PROPERTIES_3DGS, *PROPERTIES_4D, "path"):
        if name in tables.names("vertex") and (lost := int((~np.isfinite(rows[name])).sum())):
            raise InputError(
                f"{path}: {name} holds NaN or infinity in {lost} of {len(rows)} Gaussians; "
                "remove those Gaussians or export the file again."
            )
    asset = _asset(tables)
    check(asset, path)
    return asset


def sound_asset_from_bytes(data: bytes, path: Path) -> tuple[Asset, str]:
    """The same without the Gaussians that hold NaN or are beyond all bounds, and what is to be said of them."""
    return sound_part(_asset(PlyTables(data, path)), path)


def _asset(tables: PlyTables) -> Asset:
    """Unchecked."""
    path, rows = tables.path, tables.table("vertex")
    names = tables.names("vertex")
    coloured = not set(COLOUR) <= set(names) and set(PLAIN_COLOUR) <= set(names)
    moves = _is_4d(names, set(PROPERTIES_3DGS) - set(COLOUR if coloured else ()) - {FLAT_SCALE}, path)
    count = len(rows)

    def get(*properties: str) -> np.ndarray:
        """(N,k), or (N,) of one property."""
        out = np.stack([rows[p] for p in properties], -1).astype(np.float64)
        return out if len(properties) > 1 else out.squeeze(1)

    with np.errstate(over="ignore", invalid="ignore"):  # NaN, and what overflows, is for the caller
        quaternion = get(*ROTATION)
        length = np.linalg.norm(quaternion, axis=1, keepdims=True)
        quaternion = np.where(length == 0, [1.0, 0, 0, 0], quaternion / np.maximum(length, 1e-300))
        scale = np.exp(get(*(name for name in SCALE if name in names)))
        if FLAT_SCALE not in names:
            scale = np.concatenate([scale, FLATNESS * scale.min(1, keepdims=True)], 1)
        xyz, clip = get(*POSITION), _clip(tables.meta, path)
        if not tables.meta:
            scale = np.maximum(scale, SMALLEST_SCALE)
            xyz, translation = near_origin(xyz)
            clip = replace(clip, translation=translation)
        arrays = {
            "xyz": xyz,
            "t": get("t") if moves else np.zeros(count),
            "velocity": get(*VELOCITY) if moves else np.zeros((count, 3)),
            "sigma_t": np.exp(get("scale_t")) if moves else np.full(count, STATIC_SIGMA_T),
            "scale": scale,
            "rotation": quaternion,
            "rgb": _plain_colour(rows) if coloured else 0.5 + SH_C0 * get(*COLOUR),
            "opacity": 1 / (1 + np.exp(-get("opacity"))),
        }
        asset = Asset(**{k: a.astype(np.float32) for k, a in arrays.items()}, clip=clip)
    if "path" not in names:
        return asset
    if not {"path", "knot"} <= tables.counts.keys():
        raise InputError(f"{path}: its Gaussians are on paths that it lacks; export it again from Timesplat.")
    paths, index = paths_from_tables(tables.table("path"), tables.table("knot"), path), get("path")
    if not ((index >= 0) & (index < len(paths)) & (index == np.floor(index))).all():
        raise InputError(f"{path}: it has Gaussians on paths that are not there; export it again.")
    return replace(asset, path=index.astype(np.int32), paths=paths)


def _plain_colour(rows: np.ndarray) -> np.ndarray:
    """(N,3) sRGB-encoded: whole numbers fill their type, others go from 0 to 1."""
    columns = [rows[name] / (np.iinfo(rows[name].dtype).max if rows[name].dtype.kind in "iu" else 1) for name in
               PLAIN_COLOUR]  # fmt: skip
    return np.stack(columns, 1)


def _is_4d(names: list[str], needed: set[str], path: Path) -> bool:
    """Whether the properties of time are there. Raises InputError if some of them are not, or those that are needed."""
    if missing := [p for p in PROPERTIES_3DGS if p in needed and p not in names]:
        hint = "it is a compressed splat file" if "packed_position" in names else "it is not a Gaussian splat"
        raise InputError(
            f"{path}: the property {missing[0]} is missing, {hint}; export it as an uncompressed 3DGS .ply."
        )
    found = [p for p in PROPERTIES_4D if p in names]
    if found and len(found) < len(PROPERTIES_4D):
        lost = next(p for p in PROPERTIES_4D if p not in names)
        raise InputError(f"{path}: it has {found[0]} but lacks {lost}; export it again from Timesplat.")
    return bool(found)


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
