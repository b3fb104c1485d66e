# SPDX-License-Identifier: GPL-3.0-or-later
"""The files that one moment of an asset can be written as, by suffix. numpy and the standard library only, for inside
Blender, but for .sog (sog.py).

Sources: github.com/nianticlabs/spz (README.md), github.com/antimatter15/splat (convert.py),
github.com/KhronosGroup/glTF (KHR_gaussian_splatting).
"""

from __future__ import annotations

import gzip
import json
import struct
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from ...datagen.sequence import InputError
from .asset import SH_C0, Asset, linear_from_srgb, xyzw_from_wxyz
from .placement import rotate_quaternions
from .ply import columns_3dgs, ply_bytes
from .sog import sog
from .splat_files import PLAUSIBLE, SPLAT_RECORD, plausible

SPZ_COLOUR = 0.15  # of a byte's range for one of a coefficient
MAX_SPZ_FRACTION = 20  # bits after the point: a millionth
POINTS, ARRAY_BUFFER, FLOAT, UNSIGNED_BYTE = 0, 34962, 5126, 5121  # of glTF


def ply(part: Asset, frame: float) -> bytes:
    """Plain 3DGS .ply; `part`, here and below, as `slices.slice_at` gives it, with -Y up."""
    return ply_bytes(columns_3dgs(part), [f"frame {frame:g} of a 4D asset by Timesplat, -Y is up"])


def splat(part: Asset, frame: float) -> bytes:
    """Large and opaque ones first, because viewers show a .splat while it loads. Raises InputError for what would be
    taken for another kind of file."""
    order = np.argsort(-part.scale.prod(1, dtype=np.float64) * part.opacity, kind="stable")
    rows = np.empty(len(part), SPLAT_RECORD)
    rows["xyz"], rows["scale"] = part.xyz, part.scale
    rows["rgb"], rows["opacity"] = (np.round(a.clip(0, 1) * 255) for a in (part.rgb, part.opacity))
    rows["rotation"] = np.round(part.rotation * 128 + 128).clip(0, 255)
    if plausible(rows).mean() < PLAUSIBLE:
        reach = float(np.abs(part.xyz).max())
        raise InputError(f"it reaches {reach:g} units from the origin, which nobody takes for a .splat; write a .ply.")
    return rows[order].tobytes()


def spz(part: Asset, frame: float) -> bytes:
    """Niantic's, version 3, 20 bytes a Gaussian before they are packed; Y is up. Raises InputError for what is too far
    from the origin for 24 bits."""
    part = _y_up(part)
    reach = float(np.abs(part.xyz).max())
    fraction = min(int(np.floor(np.log2((2**23 - 1) / max(reach, 1e-9)))), MAX_SPZ_FRACTION)
    if fraction < 0:
        raise InputError(f"it reaches {reach:g} units from the origin, beyond what .spz can hold; write a .ply.")
    steps = np.round(part.xyz.astype(np.float64) * 2**fraction).astype("<i4")
    whole = [
        steps.view(np.uint8).reshape(-1, 3, 4)[:, :, :3],
        _byte(part.opacity * 255),
        _byte(((part.rgb - 0.5) / SH_C0 * SPZ_COLOUR + 0.5) * 255),
        _byte((np.log(part.scale) + 10) * 16),
        _smallest_three(xyzw_from_wxyz(part.rotation)),
    ]
    head = struct.pack("<4sIIBBBB", b"NGSP", 3, len(part), 0, fraction, 0, 0)
    return gzip.compress(head + b"".join(np.ascontiguousarray(a).tobytes() for a in whole), mtime=0)


def _byte(values: np.ndarray) -> np.ndarray:
    return np.round(values).clip(0, 255).astype(np.uint8)


def _smallest_three(q: np.ndarray) -> np.ndarray:
    """(N,4) x y z w -> (N,) of 32 bits: which is the largest, then a sign and nine bits of each of the others."""
    largest = np.abs(q).argmax(1)
    rows = np.arange(len(q))
    q = q * np.where(q[rows, largest] < 0, -1, 1)[:, None]
    others = np.array([[k for k in range(4) if k != i] for i in range(4)])[largest]
    small = q[rows[:, None], others]
    bits = np.round(np.abs(small) * 511 / np.sqrt(0.5)).clip(0, 511).astype(np.uint32) | (small < 0) << np.uint32(9)
    packed = largest.astype(np.uint32) << np.uint32(30)
    for k, shift in enumerate((20, 10, 0)):
        packed |= bits[:, k].astype(np.uint32) << np.uint32(shift)
    return packed.astype("<u4")


def glb(part: Asset, frame: float) -> bytes:
    """glTF with KHR_gaussian_splatting, of points in colour for readers that do not know it; Y is up."""
    part = _y_up(part)
    shown = np.concatenate([linear_from_srgb(part.rgb), part.opacity[:, None]], 1)
    attributes = {
        "POSITION": part.xyz,
        "KHR_gaussian_splatting:ROTATION": xyzw_from_wxyz(part.rotation),
        "KHR_gaussian_splatting:SCALE": part.scale,
        "KHR_gaussian_splatting:OPACITY": part.opacity,
        "KHR_gaussian_splatting:SH_DEGREE_0_COEF_0": (part.rgb - 0.5) / np.float32(SH_C0),
        "COLOR_0": _byte(shown * 255),
    }
    accessors: list[dict[str, Any]] = []
    views, data = [], b""
    for array in attributes.values():
        raw = array.tobytes()
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": len(raw), "target": ARRAY_BUFFER})
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[array.size // len(part)]
        accessor: dict[str, Any] = {
            "bufferView": len(accessors),
            "componentType": FLOAT,
            "count": len(part),
            "type": kind,
        }
        if array.dtype == np.uint8:
            accessor |= {"componentType": UNSIGNED_BYTE, "normalized": True}
        accessors.append(accessor)
        data += raw  # whole words all of them
    accessors[0] |= {"min": part.xyz.min(0).tolist(), "max": part.xyz.max(0).tolist()}
    how = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitive = {
        "attributes": {name: i for i, name in enumerate(attributes)},
        "mode": POINTS,
        "extensions": {"KHR_gaussian_splatting": how},
    }
    gltf = {
        "asset": {"version": "2.0", "generator": "Timesplat", "extras": {"frame": float(frame)}},
        "extensionsUsed": ["KHR_gaussian_splatting"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(data)}],
    }
    text = json.dumps(gltf, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _y_up(part: Asset) -> Asset:
    """Half a turn about X."""
    turn = np.diag([1.0, -1, -1])
    return replace(part, xyz=part.xyz * np.diag(turn).astype("f4"), rotation=rotate_quaternions(turn, part.rotation))


SLICE_FORMATS: dict[str, Callable[[Asset, float], bytes]] = {
    ".ply": ply,
    ".splat": splat,
    ".spz": spz,
    ".sog": sog,
    ".glb": glb,
}
