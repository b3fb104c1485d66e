# SPDX-License-Identifier: GPL-3.0-or-later
"""Every suffix both ways, and sequences of files."""

import gzip
import math
import re
import struct
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from timesplat.datagen.sequence import InputError
from timesplat.model.io import files
from timesplat.model.io.asset import STATIC_SIGMA_T, VISIBLE, Clip, LoadedAsset, rotation_matrices
from timesplat.model.io.files import (
    FRAME_SUFFIXES,
    READABLE,
    STRAIGHT,
    WRITABLE,
    frame_files,
    read_asset,
    read_frames,
    upright,
    write_asset,
)
from timesplat.model.io.pieces import to_pieces
from timesplat.model.io.ply import PROPERTIES_3DGS, columns_3dgs, write_ply
from timesplat.model.io.slice_formats import SLICE_FORMATS
from timesplat.model.io.slices import write_slice, write_slices
from timesplat.model.io.usd_stage import USD_SUFFIXES

from ...assets import assert_same, make_asset, tracked_asset

SPZ = gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 3, 1, 0, 12, 0, 0) + bytes(20))  # one Gaussian, Y up


def test_each_frame_of_a_sequence_shows_its_own_file(tmp_path):
    parts = [make_asset(n, seed=n, sigma=(9, 10)) for n in (5, 9, 3, 6)]
    names = ["f_2.ply", "f_9.ply", "f_10.ply", "f_100.ply"]
    for part, name in zip(parts, names, strict=True):
        write_slice(tmp_path / name, part, part.clip.frame_start)
    stills = [read_asset(tmp_path / n).asset for n in names]
    assert frame_files(tmp_path) == [tmp_path / n for n in names]
    loaded = read_frames([tmp_path / n for n in sorted(names)], fps=12, frame_start=7)
    asset = loaded.asset
    assert_same(asset, read_asset(tmp_path, fps=12, frame_start=7).asset, 0, 0)
    assert asset.clip == Clip(12, 7, 10) and loaded.up == "-Y"
    for frame, one in zip(range(7, 11), stills, strict=True):
        xyz, opacity = asset.at(asset.frame_to_time(frame))
        own = asset.t == np.float32(asset.frame_to_time(frame))
        np.testing.assert_array_equal(xyz[own], one.xyz)
        np.testing.assert_array_equal(opacity[own], one.opacity)  # whole
        assert opacity[~own].max() < VISIBLE / 4
        for name in ("scale", "rotation", "rgb"):
            np.testing.assert_array_equal(getattr(asset, name)[own], getattr(one, name))
    half = asset.at(asset.frame_to_time(7.5))[1] / asset.opacity
    np.testing.assert_allclose(half[:8], math.exp(-9 / 8), rtol=1e-4)
    single = read_frames([tmp_path / "f_2.ply"]).asset
    assert (single.sigma_t == STATIC_SIGMA_T).all()


@pytest.mark.parametrize("suffix", FRAME_SUFFIXES)
def test_a_folder_of_slices_of_any_kind_is_a_sequence(tmp_path, suffix):
    """In .spz Y is up, in the others -Y; upright, all show what the asset shows at each frame."""
    asset = make_asset(9, sigma=(9, 10), clip=Clip(24, 3, 6, 2.0, (1.0, 2.0, 3.0)))
    assert write_slices(tmp_path / "frames", asset, "fox", suffix) == 4
    assert [f.name for f in frame_files(tmp_path / "frames")] == [f"fox_000{k}{suffix}" for k in range(3, 7)]
    (tmp_path / "frames/notes.txt").write_text("of no account")
    standing = upright(read_asset(tmp_path / "frames", frame_start=3))
    for frame in asset.clip.frames:
        own = standing.t == np.float32(standing.frame_to_time(frame))
        found = np.sort(standing.xyz[own] + np.array(standing.clip.translation), axis=0)
        world = asset.at(asset.frame_to_time(frame))[0] * 2 + (1, 2, 3)
        np.testing.assert_allclose(found, np.sort(world, axis=0), atol=1e-3)


def test_what_is_no_sequence_is_refused(tmp_path, monkeypatch):
    asset = make_asset(9, sigma=(9, 10))
    for name in ("a.ply", "b.ply"):
        write_slice(tmp_path / name, asset, 5)
    write_ply(tmp_path / "four.ply", asset)
    write_ply(tmp_path / "tracked.ply", tracked_asset(9))
    (tmp_path / "up.spz").write_bytes(SPZ)
    for other in ("four.ply", "tracked.ply", "up.spz"):
        with pytest.raises(InputError, match=f"{other}: it is no frame of a sequence .* import it alone"):
            read_frames([tmp_path / "a.ply", tmp_path / other])
    with pytest.raises(InputError, match="USD files hold their frames themselves; import them one by one"):
        read_frames([tmp_path / "a.ply", tmp_path / "b.usdc"])
    with pytest.raises(InputError, match="No file"):
        read_frames([])
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"there is no \.ply"):
        frame_files(tmp_path / "empty")
    with pytest.raises(InputError, match="cannot be read"):
        frame_files(tmp_path / "nowhere")
    monkeypatch.setattr(files, "MAX_GAUSSIANS", 9)
    with pytest.raises(InputError, match=r"b\.ply: with it the sequence has more than 9"):
        read_frames([tmp_path / "a.ply", tmp_path / "b.ply"])


@pytest.mark.parametrize(("up", "turn"), [("Y", (0, -2, 1)), ("-Y", (0, 2, -1)), ("Z", (0, 1, 2))])
@pytest.mark.parametrize("kind", [make_asset, tracked_asset])
def test_what_is_up_in_a_file_is_up_at_last(up, turn, kind):
    """World positions are turned (`turn`: where x, y, z come from, with their signs), and covariances with them."""
    asset = kind(40)
    standing = upright(LoadedAsset(asset, up))
    assert_same(standing, upright(LoadedAsset(asset, "Y" if up == "Z" else "Z"), up), 0, 0)
    for frame in (10, 21.5, 33):
        time, worlds = asset.frame_to_time(frame), []
        for one in (asset, standing):
            R = rotation_matrices(one.rotation_at(time)) * (one.scale * np.float32(one.clip.scale))[:, None, :]
            worlds.append((one.at(time)[0] * one.clip.scale + one.clip.translation, R @ R.transpose(0, 2, 1)))
        rows, signs = np.abs(turn), np.array([1, *(1 if t >= 0 else -1 for t in turn[1:])])
        (xyz, covariance), (turned, turned_covariance) = worlds
        np.testing.assert_allclose(turned, xyz[:, rows] * signs, atol=1e-5)
        expected = covariance[:, rows][:, :, rows] * np.outer(signs, signs)
        np.testing.assert_allclose(turned_covariance, expected, atol=1e-6)


def test_files_of_a_sequence_far_from_the_origin_stay_where_they_are(tmp_path):
    """Each is read as from its own middle."""
    at = [np.array([5e6 + 3 * k, -2e5, 10.0]) for k in range(3)]
    parts = [make_asset(n, seed=n) for n in (5, 9, 7)]
    for k, (part, middle) in enumerate(zip(parts, at, strict=True)):
        kinds = [(n, "<f8" if n in "xyz" else "<f4") for n in PROPERTIES_3DGS]
        columns = columns_3dgs(part) | dict(zip("xyz", (part.xyz + middle).T, strict=True))
        rows = np.rec.fromarrays([columns[n] for n, _ in kinds], kinds)
        head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
        head += [f"property {'double' if n in 'xyz' else 'float'} {n}" for n, _ in kinds]
        (tmp_path / f"f_{k}.ply").write_bytes("\n".join([*head, "end_header", ""]).encode() + rows.tobytes())
    asset = read_asset(tmp_path).asset
    world = asset.xyz.astype(float) + asset.clip.translation
    expected = np.concatenate([part.xyz + middle for part, middle in zip(parts, at, strict=True)])
    np.testing.assert_allclose(world, expected, atol=2e-6)


# ---------------------------------------------------------------- one file


@pytest.mark.parametrize("suffix", READABLE)
def test_no_file_and_a_folder(tmp_path, suffix, monkeypatch):
    if suffix in USD_SUFFIXES:
        pytest.importorskip("pxr")
    with pytest.raises(InputError, match="no such file"):
        read_asset(tmp_path / f"a{suffix}")
    (tmp_path / f"b{suffix}").mkdir()
    with pytest.raises(InputError, match="it is a folder"):
        read_frames([tmp_path / f"b{suffix}"])

    def full(path):
        raise MemoryError

    monkeypatch.setitem(files.READERS, suffix, full)
    with pytest.raises(InputError, match="it takes more memory than there is"):
        read_asset(tmp_path / f"a{suffix}")


@pytest.mark.parametrize("suffix", [s for s in WRITABLE if s not in STRAIGHT])
def test_what_is_written_is_read_back(tmp_path, suffix):
    if suffix in USD_SUFFIXES:
        pytest.importorskip("pxr")
    asset, path = make_asset(), tmp_path / f"a{suffix}"
    assert write_asset(path, asset) == len(asset) and path.is_file()
    loaded = read_asset(path)
    assert (loaded.up, loaded.note, loaded.motion) == ("Z", "", None)
    assert_same(asset, loaded.asset)


@pytest.mark.parametrize("suffix", [s for s in WRITABLE if s not in STRAIGHT])
def test_pieces_are_written_in_place_of_paths(tmp_path, suffix):
    if suffix in USD_SUFFIXES:
        pytest.importorskip("pxr")
    asset, path = tracked_asset(), tmp_path / f"a{suffix}"
    pieces = to_pieces(asset)
    assert write_asset(path, asset, pieces=True) == len(pieces) > len(asset)
    assert_same(pieces, read_asset(path).asset)
    with pytest.raises(InputError, match="rgb holds NaN"):
        write_asset(path, replace(asset, rgb=asset.rgb * np.float32("nan")), pieces=True)


@pytest.mark.parametrize("suffix", sorted(SLICE_FORMATS.keys() & set(READABLE)))
def test_a_frame_that_is_written_is_read_back(tmp_path, suffix):
    asset, path = make_asset(), tmp_path / f"a{suffix.upper()}"
    count = write_asset(path, asset, frame=12.5)
    loaded = read_asset(path)
    assert count == len(loaded.asset) == (asset.at(asset.frame_to_time(12.5))[1] >= VISIBLE).sum()
    assert loaded.up == ("Y" if suffix == ".spz" else "-Y") and (loaded.asset.sigma_t == STATIC_SIGMA_T).all()


def test_options_go_to_the_writer(tmp_path):
    pytest.importorskip("pxr")
    asset = make_asset()
    motion = np.tile(np.eye(4), (24, 1, 1))
    motion[:, 0, 3] = np.arange(24)
    write_asset(tmp_path / "a.usda", asset, mode="points", motion=motion)
    np.testing.assert_allclose(read_asset(tmp_path / "a.usda").motion, motion, atol=1e-12)
    with pytest.raises(TypeError, match="mode"):
        write_asset(tmp_path / "a.ply", asset, mode="points")


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (read_asset, "its name must end in .ply, .splat, .spz, .sog, .4dgs, .html, .usd*; choose one of these."),
        (lambda path: write_asset(path, make_asset()), "cannot write that; choose .ply, .4dgs, .html, .usd*."),
        (
            lambda path: write_asset(path, make_asset(), frame=3),
            "the name of a slice must end in .ply, .splat, .spz, .sog, .glb;",
        ),
    ],
)
def test_an_unknown_suffix_is_refused_in_a_sentence(tmp_path, call, words):
    with pytest.raises(InputError, match=re.escape(f"a.obj: {words}")):
        call(tmp_path / "a.obj")


def test_a_new_format_is_one_entry(tmp_path, monkeypatch):
    asset = make_asset(3)
    monkeypatch.setitem(files.READERS, ".new", lambda path: LoadedAsset(asset, "Y", path.read_text()))
    monkeypatch.setitem(files.WRITERS, ".new", lambda path, asset: path.write_text(f"{len(asset)}"))
    assert write_asset(tmp_path / "a.new", asset) == 3
    assert read_asset(tmp_path / "a.new").note == "3"


def test_neither_torch_nor_pxr_is_imported_before_it_is_needed():
    code = "import sys, timesplat.model.io.files\nprint([m for m in ('torch', 'pxr', 'bpy') if m in sys.modules])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.strip() == "[]"
