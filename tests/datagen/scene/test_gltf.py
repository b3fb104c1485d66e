# SPDX-License-Identifier: GPL-3.0-or-later
import pytest

from timesplat.datagen.scene.gltf import check_gltf

from ..helpers import assert_refused, glb_bytes, triangle_document, write_file


def test_what_is_sound_passes(tmp_path):
    document, binary = triangle_document()
    check_gltf(write_file(tmp_path / "a.glb", glb_bytes(document, binary)), tmp_path)
    document["buffers"][0]["uri"] = "a.bin"
    write_file(tmp_path / "a.bin", binary)
    check_gltf(write_file(tmp_path / "a.gltf", document), tmp_path)


@pytest.mark.parametrize("x", [float("nan"), float("inf"), -1e30, 2e12])
def test_mad_vertices(tmp_path, x):
    assert_refused(write_file(tmp_path / "a.glb", glb_bytes(*triangle_document(x))), "vertices")


def test_data_outside_of_the_root(tmp_path):
    inside = tmp_path / "in"
    inside.mkdir()
    document, binary = triangle_document(uri="../a.bin")
    write_file(tmp_path / "a.bin", binary)
    asset = write_file(inside / "a.gltf", document)
    assert_refused(asset, "../a.bin", "outside", "--root")
    check_gltf(asset, tmp_path)
    assert_refused(write_file(inside / "c.gltf", triangle_document(uri="no.bin")[0]), "no.bin", "missing")
