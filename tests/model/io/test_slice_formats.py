# SPDX-License-Identifier: GPL-3.0-or-later
"""One moment as files of other programs: read by plain loops, and by our own readers."""

import json
import struct
from dataclasses import replace

import numpy as np
import pytest

from timesplat.datagen.sequence import InputError
from timesplat.model.io import slices
from timesplat.model.io.asset import SH_C0, linear_from_srgb, rotation_matrices
from timesplat.model.io.files import read_asset, upright
from timesplat.model.io.slice_formats import SLICE_FORMATS
from timesplat.model.io.slices import write_slice

from ...assets import make_asset, tracked_asset

ASSETS = [make_asset(300, sigma=(9, 10)), tracked_asset(300, turn=0.5)]
Y_UP = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])  # from Z up


@pytest.mark.parametrize("asset", ASSETS, ids=["lines", "paths"])
def test_spz_is_the_slice_to_its_bytes(tmp_path, asset):
    for suffix in ("ply", "spz"):
        write_slice(tmp_path / f"a.{suffix}", asset, 17.5)
    a, b = (upright(read_asset(tmp_path / f"a.{x}")) for x in ("ply", "spz"))
    np.testing.assert_allclose(b.xyz, a.xyz, atol=1e-6)
    np.testing.assert_allclose(b.opacity, a.opacity, atol=0.51 / 255)
    np.testing.assert_allclose(b.rgb, a.rgb, atol=0.51 / 255 * SH_C0 / 0.15)
    np.testing.assert_allclose(np.log(b.scale), np.log(a.scale), atol=0.51 / 16)
    np.testing.assert_allclose(rotation_matrices(b.rotation), rotation_matrices(a.rotation), atol=8e-3)
    assert (tmp_path / "a.spz").stat().st_size < 0.4 * (tmp_path / "a.ply").stat().st_size


@pytest.mark.parametrize("largest", range(4))
@pytest.mark.parametrize("sign", [-1, 1])
def test_every_largest_component_of_a_quaternion_is_packed(tmp_path, largest, sign):
    asset = ASSETS[0][np.arange(30)]
    q = np.random.default_rng(largest).normal(size=(30, 4))
    q[:, largest] = 3 * sign
    q = (q / np.linalg.norm(q, axis=1, keepdims=True)).astype(np.float32)
    write_slice(tmp_path / "a.spz", replace(asset, rotation=q), 17, cut=0)
    got = upright(read_asset(tmp_path / "a.spz"))
    np.testing.assert_allclose(rotation_matrices(got.rotation), rotation_matrices(q), atol=8e-3)


@pytest.mark.parametrize("reach", [1e-3, 6.9, 5000, 7e6])
def test_spz_takes_as_many_bits_as_there_are(tmp_path, reach):
    asset = ASSETS[0]
    asset = replace(asset, clip=replace(asset.clip, scale=reach / 0.8, translation=(0, 0, 0)))
    write_slice(tmp_path / "a.spz", asset, 17, cut=0)
    xyz = asset.at(asset.frame_to_time(17))[0] * np.float32(reach / 0.8)
    np.testing.assert_allclose(upright(read_asset(tmp_path / "a.spz")).xyz, xyz, atol=max(2**-21, 2**-22 * reach * 1.1))


def test_what_spz_cannot_hold_is_refused(tmp_path):
    asset = replace(ASSETS[0], clip=replace(ASSETS[0].clip, translation=(0, 1e8, 0)))
    with pytest.raises(InputError, match=r"a\.spz: it reaches 1e\+08 units from the origin, .* write a \.ply"):
        write_slice(tmp_path / "a.spz", asset, 17)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("asset", ASSETS, ids=["lines", "paths"])
def test_glb_by_its_specification(tmp_path, asset):
    n = write_slice(tmp_path / "a.glb", asset, 17.5)
    data = (tmp_path / "a.glb").read_bytes()
    magic, version, length, size, kind = struct.unpack_from("<4sII I4s", data)
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON") and size % 4 == 0
    gltf = json.loads(data[20 : 20 + size])
    binary, kind = struct.unpack_from("<I4s", data, 20 + size)
    assert kind == b"BIN\0" and binary == gltf["buffers"][0]["byteLength"] == length - 28 - size
    assert gltf["extensionsUsed"] == ["KHR_gaussian_splatting"] and "extensionsRequired" not in gltf
    (primitive,) = gltf["meshes"][gltf["nodes"][gltf["scenes"][0]["nodes"][0]]["mesh"]]["primitives"]
    assert primitive["mode"] == 0
    assert primitive["extensions"]["KHR_gaussian_splatting"] == {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
    }
    found = {}
    for name, index in primitive["attributes"].items():
        accessor = gltf["accessors"][index]
        view = gltf["bufferViews"][accessor["bufferView"]]
        assert view["byteOffset"] % 4 == 0 and accessor["count"] == n
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        dtype = {5126: "<f4", 5121: "u1"}[accessor["componentType"]]
        begin = 28 + size + view["byteOffset"]
        found[name] = np.frombuffer(data[begin : begin + view["byteLength"]], dtype).reshape(n, width)
    time = asset.frame_to_time(17.5)
    xyz, opacity = asset.at(time)
    seen = opacity >= 0.05
    world = (xyz[seen] * 2 + [1, 2, 3]) @ Y_UP.T
    np.testing.assert_allclose(found["POSITION"], world, atol=1e-5)
    accessor = gltf["accessors"][primitive["attributes"]["POSITION"]]
    np.testing.assert_array_equal(
        [accessor["min"], accessor["max"]], [f(found["POSITION"], 0) for f in (np.min, np.max)]
    )
    of = {k.removeprefix("KHR_gaussian_splatting:"): x for k, x in found.items()}
    np.testing.assert_allclose(of["SCALE"], 2 * asset.soft_scale()[seen], rtol=1e-5)
    turned = rotation_matrices(of["ROTATION"][:, [3, 0, 1, 2]])
    np.testing.assert_allclose(turned, Y_UP @ rotation_matrices(asset.rotation_at(time)[seen]), atol=1e-5)
    np.testing.assert_allclose(of["OPACITY"][:, 0], opacity[seen], atol=1e-6)
    np.testing.assert_allclose(0.5 + SH_C0 * of["SH_DEGREE_0_COEF_0"], asset.rgb[seen], atol=1e-6)
    np.testing.assert_allclose(of["COLOR_0"][:, :3] / 255, linear_from_srgb(asset.rgb[seen]), atol=0.51 / 255)


@pytest.mark.parametrize("suffix", SLICE_FORMATS)
def test_the_same_moment_gives_the_same_bytes(tmp_path, suffix):
    for folder in ("one", "two"):
        write_slice(tmp_path / folder / f"a{suffix}", ASSETS[1], 12)
    assert (tmp_path / "one" / f"a{suffix}").read_bytes() == (tmp_path / "two" / f"a{suffix}").read_bytes()
    part = slices.slice_at(ASSETS[1], 12)
    assert SLICE_FORMATS[suffix](part, 12.0) == (tmp_path / "one" / f"a{suffix}").read_bytes()
