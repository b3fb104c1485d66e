# SPDX-License-Identifier: GPL-3.0-or-later
"""The .ply of an asset: round trips, foreign files, and every kind of damage."""

import contextlib
import os
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from timesplat.datagen.sequence import InputError
from timesplat.model.io.asset import SH_C0, Asset, Clip, check
from timesplat.model.io.ply import read_ply, write_ply

from ...assets import assert_same, make_asset, tracked_asset

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
        (b"binary_little_endian", b"ascii", ("ascii", "convert")),
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


# ---------------------------------------------------------------- paths


def assert_near(back, asset):
    """Poses within what `ply_paths` states, at every frame and between."""
    paths, read = asset.paths, back.paths
    for name in ("start", "end", "count"):
        np.testing.assert_array_equal(getattr(read, name), getattr(paths, name))
    np.testing.assert_array_equal(back.path, asset.path)
    size = np.array(
        [np.ptp(paths.place[i : i + n], axis=0).max() / 2 for i, n in zip(paths.first, paths.count, strict=True)]
    )
    step = np.repeat(size / 65534, paths.count) + 3e-7 * np.abs(paths.place).max(1)
    assert (np.abs(read.place - paths.place) <= step[:, None]).all()
    chord = np.linalg.norm(read.rotation.astype(np.float64) - paths.rotation, axis=1)
    assert (2 * chord).max() < 7e-5  # radians


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.integers(1, 24), min_size=1, max_size=5),
    st.integers(0, 99),
    st.floats(0, 0.5),
    st.floats(0, 3),
    st.integers(1, 9),
)
def test_round_trip_of_paths(tmp_path_factory, counts, seed, way, turn, n):
    asset, path = tracked_asset(n, counts, seed, way=way, turn=turn), tmp_path_factory.mktemp("ply") / "a.ply"
    write_ply(path, asset)
    back = read_ply(path)
    assert_near(back, asset)
    for name in ("xyz", "t", "rotation", "rgb", "scale", "velocity"):
        np.testing.assert_allclose(getattr(back, name), getattr(asset, name), rtol=1e-6, atol=3e-7, err_msg=name)
    for time in (-1.0, -0.31, 0.5, 1.0):
        (xyz, opacity), (p, o) = asset.at(time), back.at(time)
        assert np.abs(p - xyz).max() < 1e-4 and np.allclose(o, opacity, atol=1e-6)
    write_ply(path, back)
    again = read_ply(path)
    np.testing.assert_allclose(again.velocity, back.velocity, atol=2e-3)  # of the paths as they are rounded
    assert_same(replace(back, velocity=again.velocity), again, 1e-6, 4e-5)  # one step of a quaternion


def test_places_are_right_to_a_hundred_thousandth(tmp_path):
    asset = tracked_asset(8, (24,) * 8, way=0.3)
    write_ply(tmp_path / "a.ply", asset)
    assert np.abs(read_ply(tmp_path / "a.ply").paths.place - asset.paths.place).max() < 2e-5


def test_a_path_of_one_knot_is_exact(tmp_path):
    asset = tracked_asset(5, (1, 1))
    write_ply(tmp_path / "a.ply", asset)
    np.testing.assert_array_equal(read_ply(tmp_path / "a.ply").paths.place, asset.paths.place)


def test_velocities_of_paths_are_written_though_none_are_given(tmp_path):
    asset = tracked_asset(20)
    still = tracked_asset(20)
    still.velocity[:] = 0
    for name, a in (("a", asset), ("b", still)):
        write_ply(tmp_path / f"{name}.ply", a)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    assert np.abs(read_ply(tmp_path / "b.ply").velocity).max() > 0.1


def test_plyfile_reads_paths(tmp_path):
    plyfile = pytest.importorskip("plyfile")
    a = tracked_asset(30)
    write_ply(tmp_path / "a.ply", a)
    ply = plyfile.PlyData.read(tmp_path / "a.ply")
    assert [e.name for e in ply.elements] == ["vertex", "path", "knot"] and "timesplat version 2" in ply.comments
    v, path, knot = ply.elements
    assert v.properties[-1].name == "path" and all(p.val_dtype == "f4" for p in v.properties)
    np.testing.assert_array_equal(v["path"], a.path)
    np.testing.assert_array_equal(path["end"], a.paths.end)
    np.testing.assert_array_equal(path["knots"], [1, 2, 5, 24])
    y = np.repeat(path["y"], path["knots"]) + np.repeat(path["size"], path["knots"]) * knot["y"] / 32767
    np.testing.assert_allclose(y, a.paths.place[:, 1], atol=2e-5)
    np.testing.assert_allclose(knot["rot_2"] / 32767, a.paths.rotation[:, 2], atol=2e-5)


def test_either_byte_order_and_other_types(tmp_path):
    plyfile = pytest.importorskip("plyfile")
    write_ply(tmp_path / "a.ply", tracked_asset(9))
    ply = plyfile.PlyData.read(tmp_path / "a.ply", mmap=False)
    wide = {"f4": "f8", "i4": "u4", "i2": "i4"}
    parts = [
        plyfile.PlyElement.describe(e.data.astype([(n, wide[t[1:]]) for n, t in e.data.dtype.descr]), e.name)
        for e in ply
    ]
    plyfile.PlyData(parts, byte_order=">").write(tmp_path / "b.ply")
    one, other = read_ply(tmp_path / "a.ply"), read_ply(tmp_path / "b.ply")
    np.testing.assert_array_equal(other.paths.place, one.paths.place)
    np.testing.assert_array_equal(other.path, one.path)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (b"element path 4", b"element path 5", ("truncated", "32 knots")),
        (b"element path 4", b"element path 3", ("knots",)),
        (b"element path 4", b"element path 0", ("knots",)),
        (b"element path 4", b"element path -4", ("no paths",)),
        (b"element path 4", b"element path 99999999999999", ("truncated", "paths")),
        (b"element knot 32", b"element knot 31", ("31 knots",)),
        (b"element knot 32", b"element knot 0", ("0 knots",)),
        (b"element knot 32", b"element knot 33", ("truncated", "33 knots")),
        (b"element knot 32", b"element knots 32", ("lacks",)),
        (b"element path 4", b"element face 4", ("lacks",)),
        (b"property int knots", b"property int Knots", ("lacks knots",)),
        (b"property short rot_3", b"property short rot_4", ("lacks rot_3",)),
        (b"property short rot_3", b"property list uchar short rot_3", ("header",)),
        (b"timesplat version 2", b"timesplat version 3", ("newer",)),
    ],
)
def test_wrong_headers_of_paths_are_refused(tmp_path, old, new, words):
    write_ply(tmp_path / "a.ply", tracked_asset(5))
    data = (tmp_path / "a.ply").read_bytes()
    assert data.count(old) >= 1
    (tmp_path / "b.ply").write_bytes(data.replace(old, new, 1))
    refused(tmp_path / "b.ply", *words)


@pytest.mark.parametrize(
    ("element", "prop", "value", "words"),
    [
        ("vertex", "path", np.nan, ("path", "1 of 5")),
        ("vertex", "path", -1, ("not there",)),
        ("vertex", "path", 0.5, ("not there",)),
        ("vertex", "path", 4, ("not there",)),
        ("vertex", "path", 1e30, ("not there",)),
        ("path", "start", np.nan, ("start",)),
        ("path", "start", 3, ("end before",)),
        ("path", "x", np.inf, ("place",)),
        ("path", "size", np.nan, ("place",)),
        ("path", "knots", 0, ("count",)),
        ("path", "knots", -2, ("count",)),
        ("path", "knots", 2**31 - 1, ("count",)),
    ],
)
def test_wrong_values_of_paths_are_refused(tmp_path, element, prop, value, words):
    plyfile = pytest.importorskip("plyfile")
    write_ply(tmp_path / "a.ply", tracked_asset(5))
    ply = plyfile.PlyData.read(tmp_path / "a.ply", mmap=False)
    ply[element][prop][1] = value
    ply.write(tmp_path / "b.ply")
    refused(tmp_path / "b.ply", *words)


def test_truncated_paths_are_refused(tmp_path):
    write_ply(tmp_path / "a.ply", tracked_asset(5))
    data = (tmp_path / "a.ply").read_bytes()
    for n in (1, 14, 32 * 14, 32 * 14 + 1, 32 * 14 + 4 * 28, 32 * 14 + 4 * 28 + 1):
        (tmp_path / "b.ply").write_bytes(data[:-n])
        refused(tmp_path / "b.ply", "truncated")


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_damaged_paths_give_an_asset_or_an_input_error(tmp_path_factory, data):
    folder = tmp_path_factory.getbasetemp()
    write_ply(folder / "fuzz.ply", tracked_asset(2, (1, 3)))
    raw = bytearray((folder / "fuzz.ply").read_bytes())
    begin = raw.index(b"element path") if data.draw(st.booleans()) else 0
    for _ in range(data.draw(st.integers(1, 4))):
        raw[data.draw(st.integers(begin, len(raw) - 1))] = data.draw(st.integers(0, 255))
    (folder / "fuzz.ply").write_bytes(raw)
    with contextlib.suppress(InputError):
        back = read_ply(folder / "fuzz.ply")
        check(back)
        assert np.isfinite(back.at(0.1)[1]).all()


def test_an_element_that_is_called_path_in_another_programs_file_is_passed_over(tmp_path):
    write_ply(tmp_path / "a.ply", make_asset(3))
    data = (tmp_path / "a.ply").read_bytes()
    foreign = b"element path 1\nproperty list uchar int vertices\nend_header\n"
    (tmp_path / "a.ply").write_bytes(data.replace(b"end_header\n", foreign) + b"\x01" + bytes(4))
    assert read_ply(tmp_path / "a.ply").paths is None
