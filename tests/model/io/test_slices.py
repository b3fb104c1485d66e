# SPDX-License-Identifier: GPL-3.0-or-later
"""Moments of an asset as 3DGS files."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

from timesplat.datagen.sequence import InputError
from timesplat.model.io.asset import SH_C0, VISIBLE, Clip, rotation_matrices
from timesplat.model.io.files import read_asset
from timesplat.model.io.slices import write_slice, write_slices

from ...assets import make_asset, tracked_asset

CLIP = Clip(25.0, 3, 12, 2.5, (1.0, -2.0, 3.0), pixel=0.02)
DOWN = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # a slice's axes from the world's: Z up becomes -Y up


@pytest.mark.parametrize("frame", [3, 7.25, 12, 99, -5])
def test_a_slice_is_the_asset_at_its_time(tmp_path, frame):
    asset = make_asset(300, clip=CLIP)
    path = tmp_path / "s.ply"
    count = write_slice(path, asset, frame)
    xyz, opacity = asset.at(asset.frame_to_time(min(max(frame, 3), 12)))
    seen = opacity >= VISIBLE
    assert count == seen.sum() < 300
    rows = PlyData.read(path)["vertex"]
    get = lambda *names: np.stack([rows[n] for n in names], 1).astype(float)  # noqa: E731
    world = (xyz[seen] * 2.5 + [1, -2, 3]) @ DOWN.T
    np.testing.assert_allclose(get("x", "y", "z"), world, atol=2e-6)
    np.testing.assert_allclose(1 / (1 + np.exp(-get("opacity")[:, 0])), opacity[seen], atol=1e-6)
    np.testing.assert_allclose(np.exp(get("scale_0", "scale_1", "scale_2")), asset.soft_scale()[seen] * 2.5, rtol=1e-5)
    np.testing.assert_allclose(0.5 + SH_C0 * get("f_dc_0", "f_dc_1", "f_dc_2"), asset.rgb[seen], atol=1e-6)
    turned = rotation_matrices(get("rot_0", "rot_1", "rot_2", "rot_3"))
    np.testing.assert_allclose(turned, DOWN @ rotation_matrices(asset.rotation[seen]), atol=1e-5)
    names = [p.name for p in rows.properties]
    assert "t" not in names and not any(n.startswith("f_rest") for n in names)


@pytest.mark.parametrize("frame", [3, 7.25, 12])
def test_a_slice_of_what_rides_on_paths_has_their_turn(tmp_path, frame):
    asset = tracked_asset(60, clip=CLIP, turn=0.5)
    time = asset.frame_to_time(frame)
    count = write_slice(tmp_path / "s.ply", asset, frame)
    seen = asset.paths.there(time)[asset.path] & (asset.opacity >= VISIBLE)
    got = read_asset(tmp_path / "s.ply").asset
    assert count == seen.sum() and got.paths is None
    np.testing.assert_allclose(got.xyz, (asset.at(time)[0][seen] * 2.5 + [1, -2, 3]) @ DOWN.T, atol=5e-6)
    turned = DOWN @ rotation_matrices(asset.rotation_at(time)[seen])
    np.testing.assert_allclose(rotation_matrices(got.rotation), turned, atol=1e-5)
    assert np.abs(turned - DOWN @ rotation_matrices(asset.rotation[seen])).max() > 0.1


def test_a_slice_as_splat_is_the_same_to_its_bytes(tmp_path):
    asset = make_asset(100, clip=CLIP)
    write_slice(tmp_path / "s.ply", asset, 6)
    write_slice(tmp_path / "s.splat", asset, 6)
    a, b = (read_asset(tmp_path / f"s.{x}").asset for x in ("ply", "splat"))
    order = np.argsort(-a.scale.prod(1, dtype=float) * a.opacity)
    for name, tolerance in (("xyz", 0), ("scale", 1e-6), ("rgb", 0.003), ("opacity", 0.003), ("rotation", 0.012)):
        np.testing.assert_allclose(getattr(b, name), getattr(a, name)[order], atol=tolerance)


def test_a_moment_at_which_nothing_is_visible_has_one_gaussian(tmp_path):
    asset = make_asset(30, clip=CLIP)
    asset.t[:], asset.sigma_t[:] = 1, 0.01
    assert write_slice(tmp_path / "s.ply", asset, 3) == 1
    assert read_asset(tmp_path / "s.ply").asset.opacity[0] < 1e-5
    asset.t[:], asset.velocity[:] = -1e15, 1  # where they would be is nowhere
    asset.velocity[7] = 0
    assert write_slice(tmp_path / "s.splat", asset, 3) == 1
    assert np.abs(read_asset(tmp_path / "s.splat").asset.xyz).max() < 10


def test_what_no_reader_would_take_for_a_splat_is_not_written(tmp_path):
    asset = make_asset(30, clip=CLIP)
    asset.xyz[:, 0] = 1e12
    with pytest.raises(InputError, match=r"s\.splat: it reaches .* write a \.ply"):
        write_slice(tmp_path / "s.splat", asset, 6)
    assert not list(tmp_path.iterdir())


def test_slices_come_whole_or_not_at_all(tmp_path, monkeypatch):
    asset = make_asset(30, clip=CLIP)
    assert write_slices(tmp_path / "all", asset, "x") == 10
    assert sorted(os.listdir(tmp_path / "all")) == [f"x_{f:04d}.ply" for f in range(3, 13)]
    for frame in (3, 12):
        write_slice(tmp_path / "one.ply", asset, frame)
        assert (tmp_path / "one.ply").read_bytes() == (tmp_path / "all" / f"x_{frame:04d}.ply").read_bytes()
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(InputError, match="exists already"):
        write_slices(tmp_path / "all", asset, "x")
    with pytest.raises(InputError, match="exists already"):
        write_slices(tmp_path / "one.ply", asset, "x")

    def full(self, data, calls=[]):  # noqa: B006
        calls.append(data)
        if len(calls) > 3:
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    for write in (
        lambda: write_slices(tmp_path / "more", asset, "x"),
        lambda: write_slice(tmp_path / "more.ply", asset, 5),
    ):
        with pytest.raises(InputError, match=r"more.*: it cannot be written \(No space left on device\)"):
            write()
    assert sorted(tmp_path.rglob("*")) == before
    with pytest.raises(InputError, match=r"must end in \.ply, \.splat, \.spz, \.sog, \.glb"):
        write_slice(tmp_path / "a.obj", asset, 5)
    with pytest.raises(InputError, match="NaN"):
        write_slice(tmp_path / "a.ply", replace(asset, xyz=asset.xyz * np.float32("nan")), 5)


def test_a_sentence_about_a_slice_names_its_file(tmp_path):
    """At that frame it is so large that it is infinite in the world's units."""
    asset = make_asset(4)
    asset.scale[:], asset.sigma_t[:], asset.opacity[:] = 3e38, 1e3, 1
    with pytest.raises(InputError, match=rf"^{tmp_path}/a.splat: the slice: scale holds NaN or infinity"):
        write_slice(tmp_path / "a.splat", asset, 20)
    assert not (tmp_path / "a.splat").exists()
