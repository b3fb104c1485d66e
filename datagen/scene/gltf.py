# SPDX-License-Identifier: GPL-3.0-or-later
"""Checks a glTF file before Blender opens it: for what Blender's importer finds out late, repairs in silence,
or follows out of the folder. numpy only."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from urllib.parse import unquote

import numpy as np

from ..sequence import InputError

LARGEST_COORDINATE = 1e6  # what lies beyond is damage, not size: single precision gives out
_FLOAT32 = 5126  # glTF's number for this component type


def check_gltf(path: Path) -> None:
    """Raises InputError for a .glb or .gltf that is cut or no glTF, whose positions are not finite or beyond
    LARGEST_COORDINATE, that lacks a data file, or that refers to a file outside of its folder."""
    try:
        document, binary = _read_document(path)
        referenced = [(kind, x.get("uri")) for kind in ("buffers", "images") for x in document.get(kind, [])]
    except (ValueError, struct.error, AttributeError, TypeError) as e:
        raise InputError(f"{path}: it is damaged ({e}); export it again.") from None
    for kind, uri in referenced:
        if not uri or uri.startswith("data:"):
            continue
        file = inside_folder(path, unquote(uri))
        if kind == "buffers" and not file.is_file():
            raise InputError(f"{path}: its data file {uri} is missing; put it beside it.")
    try:
        # Blender's importer turns what is not finite into zeros
        in_bounds = all(
            np.abs(points).max(initial=0) <= LARGEST_COORDINATE for points in _positions(path, document, binary)
        )
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, OverflowError) as e:
        raise InputError(f"{path}: its accessors are damaged ({e}); export it again.") from None
    if not in_bounds:
        raise InputError(f"{path}: it has vertices that are not finite or beyond {LARGEST_COORDINATE:.0e}; repair it.")


def inside_folder(path: Path, reference: str) -> Path:
    """Where a file named by the asset `path` lies; InputError if that is not below the asset's folder."""
    folder = path.resolve().parent
    file = (folder / reference).resolve()
    if not file.is_relative_to(folder):
        raise InputError(
            f"{path}: it refers to {reference}, outside of its own folder; pack it into the file or copy it beside it."
        )
    return file


def _read_document(path: Path) -> tuple[dict, bytes]:
    """The JSON document and the binary chunk ("" where there is none)."""
    data, binary = path.read_bytes(), b""
    if path.suffix.lower() == ".glb":
        magic, version, length, chunk = struct.unpack_from("<4sIII", data)
        if magic != b"glTF" or version != 2:
            raise ValueError("not a binary glTF 2.0 file")
        if length > len(data):
            raise ValueError(f"cut off after {len(data)} of {length} bytes")
        data, binary = data[20 : 20 + chunk], data[20 + chunk + 8 : length]
    document = json.loads(data)
    if not isinstance(document, dict):
        raise ValueError("not a glTF document")
    return document, binary


def _positions(path: Path, document: dict, binary: bytes):
    """(N,3) float32 of each mesh primitive whose positions are stored plainly."""
    primitives = [p for mesh in document.get("meshes", []) for p in mesh["primitives"]]
    for index in {p["attributes"]["POSITION"] for p in primitives if "POSITION" in p["attributes"]}:
        accessor = document["accessors"][index]
        if accessor["componentType"] != _FLOAT32 or "bufferView" not in accessor:
            continue  # quantised, compressed or sparse
        view = document["bufferViews"][accessor["bufferView"]]
        uri = document["buffers"][view["buffer"]].get("uri")
        if "extensions" in view or (uri and uri.startswith("data:")):
            continue
        data = inside_folder(path, unquote(uri)).read_bytes() if uri else binary
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        yield np.ndarray((accessor["count"], 3), "<f4", data, start, (view.get("byteStride", 12), 4))
