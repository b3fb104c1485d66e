# SPDX-License-Identifier: GPL-3.0-or-later
import bpy
import pytest

from timesplat.datagen.scene.importers import cause
from timesplat.datagen.scene.open import open_asset

from ..helpers import assert_refused, glb_bytes, triangle_document, write_file

TRACEBACK = """Error: Python: Traceback (most recent call last):
  File "/blender/io_scene_gltf2/__init__.py", line 2013, in execute
    return self.import_gltf2(context)
           ^^^^^^^^^^^^^^^^^^^^^^^^^^
  File "/blender/animation_pointer.py", line 733, in get
    name = asset.name
KeyError: 'no such pointer'
Location: /blender/scripts/modules/bpy/ops.py:109
"""


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (TRACEBACK, "KeyError: 'no such pointer'"),
        ("Error: Not a valid file.\nLocation: /blender/ops.py:109", "Not a valid file"),
        ("Error: first\nError: File is newer.\n", "File is newer"),
        ("Error: Python: Traceback (most recent call last):\nimport.Unsupported\n", "import.Unsupported"),
        ("Location: /x.py:1", "damaged"),
        ("", "damaged"),
    ],
)
def test_the_cause_and_not_the_place(text, told):
    assert cause(text) == told


def test_a_fault_in_the_importer_is_told_by_its_cause(tmp_path):
    document, binary = triangle_document()
    document["meshes"][0]["primitives"][0]["material"] = 7
    path = write_file(tmp_path / "a.glb", glb_bytes(document, binary))
    assert_refused(path, "TypeError")


def test_a_pointer_animation_of_a_material_without_a_name(tmp_path):
    """Blender's importer asks the wrong object for a name where the material has none."""
    import struct

    document, binary = triangle_document()
    keys = struct.pack("<2f", 0, 1) + struct.pack("<8f", 1, 0, 0, 1, 0, 1, 0, 1)
    document["buffers"][0]["byteLength"] += len(keys)
    document["bufferViews"] += [
        {"buffer": 0, "byteOffset": 60, "byteLength": 8},
        {"buffer": 0, "byteOffset": 68, "byteLength": 32},
    ]
    document["accessors"] += [
        {"bufferView": 2, "componentType": 5126, "count": 2, "type": "SCALAR", "min": [0], "max": [1]},
        {"bufferView": 3, "componentType": 5126, "count": 2, "type": "VEC4"},
    ]
    document["materials"] = [{"pbrMetallicRoughness": {"baseColorFactor": [1, 0, 0, 1]}}]
    document["meshes"][0]["primitives"][0]["material"] = 0
    pointer = {"pointer": "/materials/0/pbrMetallicRoughness/baseColorFactor"}
    target = {"path": "pointer", "extensions": {"KHR_animation_pointer": pointer}}
    document["animations"] = [
        {
            "name": "Colour",
            "channels": [{"sampler": 0, "target": target}],
            "samplers": [{"input": 2, "output": 3, "interpolation": "LINEAR"}],
        }
    ]
    document["extensionsUsed"] = ["KHR_animation_pointer"]
    asset = open_asset(write_file(tmp_path / "a.glb", glb_bytes(document, binary + keys)))
    if bpy.app.version < (5, 0):  # pointers are not read yet
        return
    assert [(c.name, c.frame_start, c.frame_end) for c in asset.clips] == [("Colour", 0, 24)]
