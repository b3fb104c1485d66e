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

LARGEST_COORDINATE = 1e12  # what lies beyond is damage, not size
_FLOAT32 = 5126  # glTF's number for this component type


def check_gltf(path: Path, root: Path) -> None:
    """Raises InputError for a .glb or .gltf that is cut or no glTF, whose positions are not finite or beyond
    LARGEST_COORDINATE, or that lacks a data file below the folder `root`."""
    try:
        document, binary = _read_document(path)
        buffers = [x.get("uri") for x in document.get("buffers", [])]
    except (ValueError, struct.error, AttributeError, TypeError, RecursionError) as e:
        raise InputError(f"{path}: it is damaged ({e}); export it again.") from None
    for uri in buffers:
        if uri and not uri.startswith("data:"):
            _data_file(path, root, uri)
    try:
        # Blender's importer turns what is not finite into zeros
        in_bounds = all(
            np.abs(points).max(initial=0) <= LARGEST_COORDINATE for points in _positions(path, root, document, binary)
        )
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, OverflowError) as e:
        raise InputError(f"{path}: its accessors are damaged ({e}); export it again.") from None
    if not in_bounds:
        raise InputError(f"{path}: it has vertices that are not finite or beyond {LARGEST_COORDINATE:.0e}; repair it.")


def _data_file(path: Path, root: Path, uri: str) -> Path:
    """Where the data of the asset `path` lie that it names; InputError if they are missing or outside of `root`."""
    file = (path.resolve().parent / unquote(uri)).resolve()
    if not file.is_relative_to(root):
        raise InputError(f"{path}: its data file {uri} lies outside of {root}; give a --root that holds both.")
    if not file.is_file():
        raise InputError(f"{path}: its data file {uri} is missing; put it beside it.")
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


def _positions(path: Path, root: Path, document: dict, binary: bytes):
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
        data = _data_file(path, root, uri).read_bytes() if uri else binary
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        yield np.ndarray((accessor["count"], 3), "<f4", data, start, (view.get("byteStride", 12), 4))
