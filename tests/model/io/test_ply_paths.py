# SPDX-License-Identifier: GPL-3.0-or-later
"""Paths in a .ply: round trips to what is stated, other readers, and every kind of damage."""

import contextlib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from timesplat.datagen.sequence import InputError
from timesplat.model.io.asset import check
from timesplat.model.io.ply import read_ply, write_ply

from ...assets import assert_same, make_asset, tracked_asset


def refused(path, *words):
    with pytest.raises(InputError) as e:
        read_ply(path)
    message = str(e.value)
    assert message.startswith(str(path)) and message.endswith(".") and "\n" not in message
    for word in words:
        assert word in message, message


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
