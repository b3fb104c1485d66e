# SPDX-License-Identifier: GPL-3.0-or-later
"""Textures that are there, missing, outside of the root, or of no kind that can be read, in each format."""

import bpy
import numpy as np
import pytest

from timesplat.datagen.scene.open import empty_session, open_asset

from ..helpers import cube, glb_bytes, triangle_document, write_file

RED = (1.0, 0.0, 0.0, 1.0)


def save_png(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    image = bpy.data.images.new("red", 2, 2)
    image.pixels[:] = RED * 4
    image.filepath_raw, image.file_format = str(path), "PNG"
    image.save()
    return path


def look():
    """The one pixel, or the first, of each image that a material shows."""
    nodes = [n for m in bpy.data.materials for n in m.node_tree.nodes if n.type == "TEX_IMAGE"]
    return [tuple(np.round(n.image.pixels[:4], 2)) for n in nodes]


def assert_grey(asset, word):
    assert look() == [(0.8, 0.8, 0.8, 1)]
    (warning,) = asset.warnings
    assert warning.startswith(f"{asset.path}: ") and word in warning and warning.endswith(".") and ";" in warning


def textured_obj(path, texture):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.with_suffix(".mtl").write_text(f"newmtl M\nKd 1 1 1\nmap_Kd {texture}\n")
    path.write_text(
        f"mtllib {path.stem}.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl M\nf 1/1 2/2 3/3\n"
    )
    return path


@pytest.mark.parametrize("texture", ["/no/such/folder/t.png", "C:\\Users\\bob\\t.png", "t.png", "../t.png"])
def test_a_missing_one_of_an_obj(tmp_path, texture):
    assert_grey(open_asset(textured_obj(tmp_path / "in" / "a.obj", texture)), "t.png is missing")


@pytest.mark.parametrize("kind", ["obj", "glb", "gltf", "blend"])
def test_the_root_says_where_paths_may_lead(tmp_path, kind):
    """A model in source/ with its pictures in textures/, as such archives are unpacked."""
    empty_session()
    save_png(tmp_path / "textures" / "t.png")
    path = tmp_path / "source" / f"a.{kind}"
    path.parent.mkdir()
    if kind == "obj":
        textured_obj(path, "../textures/t.png")
    elif kind == "blend":
        tree = bpy.data.materials.new("m").node_tree
        node = tree.nodes.new("ShaderNodeTexImage")
        node.image = bpy.data.images.load(str(tmp_path / "textures" / "t.png"))
        tree.links.new(node.outputs["Color"], tree.nodes["Principled BSDF"].inputs["Base Color"])
        cube().data.materials.append(bpy.data.materials["m"])
        bpy.ops.wm.save_as_mainfile(filepath=str(path), relative_remap=True)
    else:
        document, binary = triangle_document(image="../textures/t.png", uri="a.bin" if kind == "gltf" else None)
        write_file(path.parent / "a.bin", binary)
        write_file(path, document if kind == "gltf" else glb_bytes(document, binary))
    asset = open_asset(path, tmp_path)
    assert look() == [RED] and not asset.warnings
    assert_grey(open_asset(path), "outside")


@pytest.mark.parametrize("image", ["/etc/hostname", "%2e%2e/t.png", "link.png"])
def test_what_a_gltf_must_not_read_is_not_read(tmp_path, image):
    empty_session()
    save_png(tmp_path / "t.png")
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "link.png").symlink_to(tmp_path / "t.png")
    asset = open_asset(write_file(tmp_path / "in" / "a.glb", glb_bytes(*triangle_document(image=image))))
    assert_grey(asset, "outside")
    assert not any(image.packed_file for image in bpy.data.images)


def test_an_absolute_path_that_is_not_there_in_a_blend(tmp_path):
    empty_session()
    tree = bpy.data.materials.new("m").node_tree
    node = tree.nodes.new("ShaderNodeTexImage")
    node.image = bpy.data.images.load(str(save_png(tmp_path / "gone" / "wood.png")))
    tree.links.new(node.outputs["Color"], tree.nodes["Principled BSDF"].inputs["Base Color"])
    cube().data.materials.append(bpy.data.materials["m"])
    (tmp_path / "in").mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "in" / "a.blend"), relative_remap=False)
    (tmp_path / "gone" / "wood.png").unlink()
    assert_grey(open_asset(tmp_path / "in" / "a.blend"), "wood.png is missing")


def test_an_optional_kind_that_cannot_be_read(tmp_path):
    document, binary = triangle_document(image="t.ktx2")
    document["textures"] = [{"extensions": {"KHR_texture_basisu": {"source": 0}}}]
    document["extensionsUsed"] = ["KHR_texture_basisu"]
    (tmp_path / "t.ktx2").write_bytes(b"\xabKTX 20\xbb\r\n\x1a\n" + bytes(80))
    path = write_file(tmp_path / "a.glb", glb_bytes(document, binary))
    assert_grey(open_asset(path), "cannot be read")
    document["textures"] = [{"source": 0}]
    assert_grey(open_asset(write_file(path, glb_bytes(document, binary))), "damaged")


def test_a_missing_normal_map_bends_nothing_and_a_missing_packed_map_is_no_metal(tmp_path):
    document, binary = triangle_document(image="no.png")
    document["materials"][0]["normalTexture"] = {"index": 0}
    document["materials"][0]["pbrMetallicRoughness"] = {"metallicRoughnessTexture": {"index": 0}}
    asset = open_asset(write_file(tmp_path / "a.glb", glb_bytes(document, binary)))
    assert len(asset.warnings) == 1
    (material,) = bpy.data.materials
    shader = next(n for n in material.node_tree.nodes if n.type == "BSDF_PRINCIPLED")
    assert not shader.inputs["Normal"].is_linked and shader.inputs["Metallic"].is_linked
    assert all(pixel[2] == 0 and pixel[1] == pytest.approx(0.8) for pixel in look())
