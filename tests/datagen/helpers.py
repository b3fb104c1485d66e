# SPDX-License-Identifier: GPL-3.0-or-later
"""Small scenes and files for the tests, made with Blender or by hand."""

import json
import struct

import bpy
import numpy as np
import pytest

from timesplat.datagen.scene.measure import vertices_at
from timesplat.datagen.scene.open import open_asset
from timesplat.datagen.sequence import InputError


def cube(name="Cube", location=(0, 0, 0), size=2):
    bpy.ops.mesh.primitive_cube_add(size=size, location=location)
    bpy.context.object.name = name
    return bpy.context.object


def key(owner, path, values):
    """values: frame -> value; linear between."""
    for frame, value in values.items():
        setattr(owner, path, value)
        owner.keyframe_insert(path, frame=frame)


def to_track(owner, name):
    """Puts the current action into an NLA track of that name, as an artist does for a glTF with many clips."""
    action = owner.animation_data.action
    track = owner.animation_data.nla_tracks.new()
    track.name = name
    track.strips.new(name, int(action.frame_range[0]), action)
    owner.animation_data.action = None


def export_glb(path):
    """Writes the scene with every NLA track as an animation; returns the path."""
    bpy.ops.export_scene.gltf(
        filepath=str(path), export_animation_mode="NLA_TRACKS", export_lights=True, export_cameras=True
    )
    return path


def boxes_at(frames):
    """(F,2,3) bounds of all that is visible, at each frame."""
    parts = [np.concatenate([p for _, p in shown]) for shown in vertices_at(frames)]
    return np.round([[p.min(0), p.max(0)] for p in parts], 3)


def assert_refused(path, *words):
    with pytest.raises(InputError) as e:
        open_asset(path)
    text = str(e.value)
    assert text.startswith(str(path)) and text.endswith(".") and "\n" not in text and ";" in text
    for word in words:
        assert word in text


def glb_bytes(document, binary=b""):
    data = json.dumps(document).encode()
    data += b" " * (-len(data) % 4)
    chunks = struct.pack("<I4s", len(data), b"JSON") + data
    if binary:
        chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def triangle_document(x=1.0, uri=None, image=None):
    """A glTF document with one triangle whose last x coordinate is given, and its vertices."""
    points = struct.pack("<9f", 0, 0, 0, 0, 1, 0, x, 0, 0)
    uvs = struct.pack("<6f", 0, 0, 0, 1, 1, 0)
    d = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}}]}],
        "buffers": [{"byteLength": 60}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 24}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", "min": [0] * 3, "max": [1] * 3},
            {"bufferView": 1, "componentType": 5126, "count": 3, "type": "VEC2"},
        ],
    }
    if uri:
        d["buffers"][0]["uri"] = uri
    if image:
        d["images"], d["textures"] = [{"uri": image}], [{"source": 0}]
        d["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
        d["meshes"][0]["primitives"][0]["material"] = 0
    return d, points + uvs


def write_file(path, data):
    path.write_bytes(data if isinstance(data, bytes) else json.dumps(data).encode())
    return path
