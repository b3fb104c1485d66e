# SPDX-License-Identifier: GPL-3.0-or-later
"""The .ply of an asset: round trips, foreign files, and every kind of damage."""

import contextlib
import os

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from timesplat.datagen.sequence import InputError
from timesplat.model.io.asset import SH_C0, Asset, Clip, check
from timesplat.model.io.ply import columns_3dgs, read_ply, write_ply

from ...assets import assert_same, make_asset

CLIP = Clip(12.5, 3, 26, 0.37, (1.5, -2.0, 0.1))


def floats(lo, hi):
    return st.floats(np.float32(lo).item(), np.float32(hi).item(), width=32)


@st.composite
def assets(draw):
    n = draw(st.integers(1, 5))
    array = lambda shape, lo, hi: draw(hnp.arrays(np.float32, shape, elements=floats(lo, hi)))  # noqa: E731
    q = array((n, 4), -1, 1).astype(np.float64) + np.array([1.5, 0, 0, 0])
    start = draw(st.integers(-1000, 1000))
    return Asset(
        array((n, 3), -1e6, 1e6),
        array(n, -1, 1),
        array((n, 3), -1e6, 1e6),
        array(n, 1e-20, 1e20),
        array((n, 3), 1e-20, 1e20),
        (q / np.linalg.norm(q, axis=1, keepdims=True)).astype(np.float32),
        array((n, 3), -1, 2),
        array(n, 0, 1),
        Clip(
            draw(st.floats(0.01, 1000)),
            start,
            start + draw(st.integers(0, 500)),
            draw(st.floats(1e-6, 1e6)),
            tuple(draw(st.tuples(*[st.floats(-1e9, 1e9)] * 3))),
            draw(st.floats(0, 1)),
        ),
    )


@settings(max_examples=60, deadline=None)
@given(assets())
def test_round_trip(tmp_path_factory, asset):
    path = tmp_path_factory.mktemp("ply") / "a.ply"
    write_ply(path, asset)
    back = read_ply(path)
    np.testing.assert_array_equal(back.xyz, asset.xyz)
    np.testing.assert_array_equal(back.velocity, asset.velocity)
    np.testing.assert_array_equal(back.t, asset.t)
    for name in ("sigma_t", "scale"):  # a log near 46 keeps 46 * 2^-24 of relative precision
        np.testing.assert_allclose(getattr(back, name), getattr(asset, name), rtol=5e-6)
    for name in ("rotation", "rgb"):
        np.testing.assert_allclose(getattr(back, name), getattr(asset, name), atol=3e-7)
    np.testing.assert_allclose(back.opacity, np.clip(asset.opacity, 1e-6, 1 - 1e-6), atol=2e-7)
    assert back.clip == asset.clip
    assert os.listdir(path.parent) == ["a.ply"]


def test_a_second_round_trip_changes_nothing(tmp_path):
    a = make_asset(clip=CLIP)
    write_ply(tmp_path / "1.ply", a)
    write_ply(tmp_path / "2.ply", read_ply(tmp_path / "1.ply"))
    assert_same(read_ply(tmp_path / "1.ply"), read_ply(tmp_path / "2.ply"), 1e-6, 1e-7)


def test_plyfile_reads_it(tmp_path):
    plyfile = pytest.importorskip("plyfile")
    a = make_asset(clip=CLIP)
    write_ply(tmp_path / "a.ply", a)
    ply = plyfile.PlyData.read(tmp_path / "a.ply")
    v = ply["vertex"]
    names = [p.name for p in v.properties]
    assert names[:7] == ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
    scale, rot = [f"scale_{i}" for i in range(3)], [f"rot_{i}" for i in range(4)]
    assert names[7:] == [*scale, *rot, "t", "scale_t", "vx", "vy", "vz"]
    np.testing.assert_array_equal(v["y"], a.xyz[:, 1])
    np.testing.assert_allclose(0.5 + SH_C0 * v["f_dc_2"], a.rgb[:, 2], atol=1e-6)
    np.testing.assert_allclose(1 / (1 + np.exp(-v["opacity"])), a.opacity, atol=1e-6)
    np.testing.assert_allclose(np.exp(v["scale_t"]), a.sigma_t, rtol=1e-6)
    assert "timesplat fps 12.5" in ply.comments and "timesplat colour_space sRGB" in ply.comments


@pytest.mark.parametrize("order", "<>")
def test_plain_3dgs_is_static(tmp_path, order):
    """As the original 3DGS code writes it: normals, f_rest, quaternions of any length, either byte order."""
    plyfile = pytest.importorskip("plyfile")
    names = [
        "x",
        "y",
        "z",
        "nx",
        "ny",
        "nz",
        "f_dc_0",
        "f_dc_1",
        "f_dc_2",
        *(f"f_rest_{i}" for i in range(45)),
    ]
    names += ["opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    rows = np.zeros(4, [(n, "f4") for n in names])
    rows["rot_0"], rows["x"], rows["rot_1"] = [3, 3, 0, 3], [1, 2, 3, 4], [0, 4, 0, 0]
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")], byte_order=order).write(tmp_path / "a.ply")
    a = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(a.xyz[:, 0], [1, 2, 3, 4])
    np.testing.assert_allclose(a.rotation[1], [0.6, 0.8, 0, 0], atol=1e-7)
    np.testing.assert_array_equal(a.rotation[2], [1, 0, 0, 0])
    for time in (-1, 0.3, 1):
        position, opacity = a.at(time)
        np.testing.assert_array_equal(position, a.xyz)
        np.testing.assert_array_equal(opacity, np.float32(0.5))
    assert a.clip == Clip()


def columns_ply(columns, kinds=None) -> bytes:
    """A plain .ply of (N,) columns, floats unless `kinds` says otherwise."""
    kinds = kinds or {}
    rows = np.rec.fromarrays(list(columns.values()), [(name, kinds.get(name, "<f4")) for name in columns])
    types = {"<f4": "float", "<f8": "double", "u1": "uchar"}
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    head += [f"property {types[kinds.get(name, '<f4')]} {name}" for name in columns]
    return "\n".join([*head, "end_header", ""]).encode() + rows.tobytes()


def test_discs_are_flat_gaussians(tmp_path):
    """2DGS has two scales; the third axis is the disc's normal."""
    a = make_asset(9)
    columns = columns_3dgs(a)
    del columns["scale_2"]
    (tmp_path / "a.ply").write_bytes(columns_ply(columns))
    got = read_ply(tmp_path / "a.ply")
    np.testing.assert_allclose(got.scale[:, :2], a.scale[:, :2], rtol=1e-5)
    np.testing.assert_allclose(got.scale[:, 2], 1e-3 * a.scale[:, :2].min(1), rtol=1e-5)
    np.testing.assert_allclose(got.rotation, a.rotation, atol=1e-6)


@pytest.mark.parametrize("kind", ["u1", "<f4"])
def test_plain_colours_are_colours(tmp_path, kind):
    a = make_asset(9)
    columns = {k: x for k, x in columns_3dgs(a).items() if not k.startswith("f_dc_")}
    rgb = np.round(a.rgb * 255) if kind == "u1" else a.rgb
    columns |= dict(zip(("red", "green", "blue"), rgb.T, strict=True))
    (tmp_path / "a.ply").write_bytes(columns_ply(columns, dict.fromkeys(("red", "green", "blue"), kind)))
    np.testing.assert_allclose(read_ply(tmp_path / "a.ply").rgb, a.rgb, atol=0.51 / 255 if kind == "u1" else 1e-6)


def test_coordinates_of_maps_go_into_the_translation(tmp_path):
    a, at = make_asset(300), np.array([448_262.25, 5_411_932.5, 217.0])
    columns = columns_3dgs(a) | dict(zip("xyz", (a.xyz + at).T, strict=True))
    (tmp_path / "a.ply").write_bytes(columns_ply(columns, dict.fromkeys("xyz", "<f8")))
    got = read_ply(tmp_path / "a.ply")
    np.testing.assert_allclose(got.clip.translation, at, atol=1)
    np.testing.assert_allclose(got.xyz.astype(float) + got.clip.translation, a.xyz + at, atol=1e-6)


def test_zero_scales_of_others_are_as_small_as_can_be(tmp_path):
    columns = columns_3dgs(make_asset(2))
    columns["scale_1"] = np.array([-3, -500.0])
    (tmp_path / "a.ply").write_bytes(columns_ply(columns))
    np.testing.assert_allclose(read_ply(tmp_path / "a.ply").scale[:, 1], [np.exp(-3), 1e-9], rtol=1e-6)


def test_files_without_the_pixel_comment_are_read(tmp_path):
    write_ply(tmp_path / "a.ply", make_asset(3, clip=CLIP))
    data = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(data.replace(b"comment timesplat pixel 0.0\n", b""))
    assert read_ply(tmp_path / "a.ply").clip.pixel == 0


def refused(path, *words):
    with pytest.raises(InputError) as e:
        read_ply(path)
    message = str(e.value)
    assert message.startswith(str(path)) and message.endswith(".") and "\n" not in message
    for word in words:
        assert word in message, message


def test_truncation_anywhere_is_refused(tmp_path):
    write_ply(tmp_path / "a.ply", make_asset(3, clip=CLIP))
    data = (tmp_path / "a.ply").read_bytes()
    bad = tmp_path / "b.ply"
    header = data.index(b"end_header\n") + 11
    for n in [0, 1, 3, 4, 20, header // 2, *range(header - 12, header + 3), header + 76, len(data) - 1]:
        bad.write_bytes(data[:n])
        refused(bad)
    refused(bad, "truncated", "3 Gaussians", "for 2")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (b"binary_little_endian", b"ascii", ("its element vertex holds what is no number",)),
        (b"binary_little_endian", b"binary_middle_endian", ("header",)),
        (b"ply\n", b"PK\x03\x04", ("not a .ply",)),
        (b"element vertex", b"element chunk", ("chunk", "uncompressed")),
        (b"element vertex 3", b"element vertex three", ("header",)),
        (b"element vertex 3", b"element vertex 999999999999999999", ("truncated",)),
        (b"element vertex 3", b"element vertex -3", ("header",)),
        (b"element vertex 3", b"element vertex 0", ("no Gaussians",)),
        (b"property float f_dc_1", b"property float red", ("f_dc_1",)),
        (b"property float vy", b"property float wy", ("lacks vy",)),
        (b"property float x", b"property list uchar int x", ("header",)),
        (b"property float x", b"property quux x", ("header",)),
        (b"property float x", b"property float y", ("header",)),
        (b"timesplat fps 12.5", b"timesplat fps banana", ("comments",)),
        (b"timesplat fps 12.5", b"timesplat fps -1", ("fps",)),
        (b"timesplat fps 12.5", b"timesplat fps nan", ("fps",)),
        (b"timesplat scale", b"timesplat skale", ("comments",)),
        (b"timesplat version 1", b"timesplat version 9", ("newer",)),
        (b"timesplat frame_end 26", b"timesplat frame_end 1", ("frame range",)),
    ],
)
def test_wrong_headers_are_refused(tmp_path, old, new, words):
    write_ply(tmp_path / "a.ply", make_asset(3, clip=CLIP))
    data = (tmp_path / "a.ply").read_bytes()
    assert old in data
    (tmp_path / "b.ply").write_bytes(data.replace(old, new, 1))
    refused(tmp_path / "b.ply", *words)


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_damaged_bytes_give_an_asset_or_an_input_error(tmp_path_factory, data):
    folder = tmp_path_factory.getbasetemp()
    write_ply(folder / "fuzz.ply", make_asset(2))
    raw = bytearray((folder / "fuzz.ply").read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    (folder / "fuzz.ply").write_bytes(raw)
    with contextlib.suppress(InputError):
        check(read_ply(folder / "fuzz.ply"))


def test_missing_file_and_folder(tmp_path):
    refused(tmp_path / "none.ply", "no such file")
    refused(tmp_path, "cannot be read")


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("prop", ["x", "scale_2", "opacity", "rot_3", "t", "scale_t", "vy"])
def test_nan_in_a_file_is_refused_by_name(tmp_path, prop, value):
    plyfile = pytest.importorskip("plyfile")
    write_ply(tmp_path / "a.ply", make_asset(3, clip=CLIP))
    ply = plyfile.PlyData.read(tmp_path / "a.ply", mmap=False)
    ply["vertex"][prop][1] = value
    ply.write(tmp_path / "b.ply")
    refused(tmp_path / "b.ply", prop, "1 of 3")
