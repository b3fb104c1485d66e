# SPDX-License-Identifier: GPL-3.0-or-later
from pathlib import Path

import bpy
import numpy as np
import pytest

from timesplat.datagen.scene.measure import motion
from timesplat.datagen.scene.open import empty_session, open_asset

from ..helpers import assert_refused, cube, glb_bytes, key, triangle_document, write_file


@pytest.mark.parametrize("suffix", ["fbx", "obj", "usdc"])
def test_other_formats_open(tmp_path, suffix):
    empty_session()
    ob, path = cube(), str(tmp_path / f"a.{suffix}")
    if suffix != "obj":
        key(ob, "location", {1: (0, 0, 0), 12: (3, 0, 0)})
        bpy.context.scene.frame_end = 12
    if suffix == "fbx":
        bpy.ops.export_scene.fbx(filepath=path)
    elif suffix == "obj":
        bpy.ops.wm.obj_export(filepath=path)
    else:
        bpy.ops.wm.usd_export(filepath=path, export_animation=True)
    asset = open_asset(Path(path))
    clip = asset.clips[0]
    asset.play(clip)
    assert len(asset.clips) == 1
    assert clip.frame_end - clip.frame_start == (0 if suffix == "obj" else 11)
    assert motion(clip.frames(24)) == 0 if suffix == "obj" else motion(clip.frames(24)) > 0.5


def test_missing_and_unknown_files(tmp_path):
    assert_refused(tmp_path / "no.glb", "no such file")
    assert_refused(write_file(tmp_path / "a.stl", b"solid"), "cannot be opened", ".glb")


def test_damaged_files(tmp_path, two_clips):
    whole = two_clips.read_bytes()
    assert_refused(write_file(tmp_path / "cut.glb", whole[: len(whole) // 2]), "cut off")
    assert_refused(write_file(tmp_path / "junk.glb", b"junk" * 50), "damaged")
    assert_refused(write_file(tmp_path / "tiny.glb", b"gl"), "damaged")
    assert_refused(write_file(tmp_path / "a.gltf", b"{"), "damaged")
    assert_refused(write_file(tmp_path / "junk.blend", b"junk" * 50), "cannot read")
    assert_refused(write_file(tmp_path / "junk.fbx", b"junk" * 50), "junk.fbx")
    assert_refused(write_file(tmp_path / "junk.usdc", b"junk" * 50), "junk.usdc")
    document, binary = triangle_document()
    document["accessors"][0]["count"] = 10**6
    assert_refused(write_file(tmp_path / "lies.glb", glb_bytes(document, binary)), "lies.glb")


def test_no_mesh(tmp_path):
    document, binary = triangle_document()
    document["nodes"] = [{"name": "nothing"}]
    assert_refused(write_file(tmp_path / "a.glb", glb_bytes(document, binary)), "no mesh")


def test_a_missing_texture_is_said_and_never_magenta(tmp_path):
    document, binary = triangle_document(image="no.png")
    asset = open_asset(write_file(tmp_path / "a.glb", glb_bytes(document, binary)))
    used = [
        n.image for m in bpy.data.materials for n in m.node_tree.nodes if n.type == "TEX_IMAGE" and n.image is not None
    ]
    assert all(np.allclose(image.pixels[:3], 0.8, atol=0.01) for image in used)
    assert len(asset.warnings) == 1 and "no.png" in asset.warnings[0] and asset.warnings[0].endswith(".")
