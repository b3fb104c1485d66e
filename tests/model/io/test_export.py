# SPDX-License-Identifier: GPL-3.0-or-later
"""`timesplat export`: from every kind of file to every other, standing as it stood; and what is refused."""

import argparse

import numpy as np
import pytest

from timesplat.cli import main
from timesplat.model.io.asset import Clip
from timesplat.model.io.export import add_export_arguments, add_view_arguments
from timesplat.model.io.files import FRAME_SUFFIXES, READABLE, WRITABLE, read_asset, upright
from timesplat.model.io.ply import read_ply, write_ply
from timesplat.model.io.slice_formats import SLICE_FORMATS
from timesplat.model.io.slices import slice_at
from timesplat.model.io.splat_files import read_any_ply

from ...assets import make_asset, tracked_asset

CLIP = Clip(24.0, 3, 8, 2.0, (1.0, 2.0, 3.0), pixel=0.01)
ASTRAY = 2e-4  # of a metre, by the coarsest format


@pytest.fixture
def asset(tmp_path):
    asset = make_asset(40, clip=CLIP, sigma=(9, 10))
    write_ply(tmp_path / "a.ply", asset)
    return asset


def export(*words) -> int:
    return main(["export", *map(str, words)])


def world(asset, frame) -> np.ndarray:
    """Where what is visible at a frame stands, in any order."""
    xyz, opacity = asset.at(asset.frame_to_time(frame))
    return (xyz * asset.clip.scale + np.array(asset.clip.translation))[opacity >= 0.05]


def assert_stands(found: np.ndarray, expected: np.ndarray, atol: float = ASTRAY) -> None:
    assert len(found) == len(expected)
    assert np.abs(found[:, None] - expected[None]).max(2).min(1).max() < atol


def needs(suffix: str) -> None:
    if suffix.startswith(".usd"):
        pytest.importorskip("pxr")
    if suffix == ".4dgs":
        pytest.importorskip("fourdgs")


@pytest.mark.parametrize("suffix", [s for s in WRITABLE if s not in (".usd", ".usda")])
def test_4d_files_stand_where_the_asset_stands_and_come_back(asset, tmp_path, suffix):
    needs(suffix)
    assert export(tmp_path / "a.ply", tmp_path / f"b{suffix}") == 0
    assert export(tmp_path / f"b{suffix}", tmp_path / "c.ply") == 0
    back = read_ply(tmp_path / "c.ply")
    for frame in (3, 5.5, 8):
        assert_stands(world(back, frame), world(asset, frame), 3e-3 if suffix == ".4dgs" else 1e-5)


@pytest.mark.parametrize("suffix", sorted(SLICE_FORMATS.keys() & set(READABLE)))
def test_a_moment_is_turned_once_on_every_way(asset, tmp_path, suffix):
    """Slices have another axis up; as 4D .ply and as USD they stand as they stood, and a slice of a slice is the
    slice, whatever kind the two are."""
    moment = tmp_path / f"m{suffix}"
    assert export(tmp_path / "a.ply", moment, "--frame", 5) == 0
    expected = world(asset, 5)
    assert export(moment, tmp_path / "b.ply") == 0
    assert_stands(world(read_ply(tmp_path / "b.ply"), 1), expected)
    assert export(moment, tmp_path / "again.ply", "--frame", 0) == 0
    again = read_any_ply(tmp_path / "again.ply")
    assert again.up == "-Y"
    assert_stands(again.asset.xyz, slice_at(asset, 5).xyz)
    kept = [tmp_path / "kept.ply", "--up", "Z"]  # what is up is said otherwise: nothing is turned
    assert export(moment, *kept) == 0
    assert_stands(world(read_ply(kept[0]), 0), read_asset(moment).asset.xyz)


@pytest.mark.parametrize("suffix", [".ply", ".spz"])
def test_usd_of_a_moment_is_turned_once(asset, tmp_path, suffix):
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom

    assert export(tmp_path / "a.ply", tmp_path / f"m{suffix}", "--frame", 5) == 0
    assert export(tmp_path / f"m{suffix}", tmp_path / "m.usdc") == 0
    stage = Usd.Stage.Open(str(tmp_path / "m.usdc"))
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    splats = stage.GetPrimAtPath("/timesplat/splats")
    points = np.array(splats.GetAttribute("points").Get(0), float)
    place = np.array(UsdGeom.Xformable(splats).ComputeLocalToWorldTransform(0))
    assert_stands(points @ place[:3, :3] + place[3, :3], world(asset, 5))


@pytest.mark.parametrize("suffix", SLICE_FORMATS)
def test_sequences_of_every_kind(asset, tmp_path, suffix, capsys):
    assert export(tmp_path / "a.ply", "--sequence", tmp_path / "frames", "--suffix", suffix) == 0
    assert "6 files" in capsys.readouterr().out
    assert sorted(p.name for p in (tmp_path / "frames").iterdir()) == [f"a_000{k}{suffix}" for k in range(3, 9)]
    if suffix not in FRAME_SUFFIXES:
        return
    assert export(tmp_path / "frames", tmp_path / "b.ply") == 0
    back = read_ply(tmp_path / "b.ply")
    assert back.clip.frames == range(1, 7)  # files say no frame
    for frame in (1, 6):
        own = back.t == np.float32(back.frame_to_time(frame))
        place = back.xyz[own] * back.clip.scale + np.array(back.clip.translation)
        assert_stands(place, world(asset, frame + 2))


def test_paths_become_pieces_where_a_format_knows_none(tmp_path, capsys):
    pytest.importorskip("fourdgs")
    asset = tracked_asset(20, clip=CLIP)
    write_ply(tmp_path / "t.ply", asset)
    assert export(tmp_path / "t.ply", tmp_path / "t.4dgs") == 0
    said = capsys.readouterr().out
    pieces = read_asset(tmp_path / "t.4dgs").asset
    assert f"{len(pieces)} Gaussians" in said and len(pieces) > 20 and "straight" in said
    write_ply(tmp_path / "s.ply", make_asset(9, clip=CLIP))
    assert export(tmp_path / "s.ply", tmp_path / "s.4dgs") == 0 and "straight" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("a.ply", "name one file to write, or a folder by --sequence"),
        ("a.ply b.ply --sequence frames", "name one file to write, or a folder by --sequence"),
        ("a.ply b.ply --half", "--mode, --half, --original and --check are for USD; drop them"),
        ("a.ply b.usdc --frame 3", "--frame is for one moment's file"),
        ("a.ply b.ply --suffix .sog", "--suffix is for the files of --sequence"),
        ("a.ply b.ply --frame 3 --pieces", "--pieces is for what has time"),
        ("a.ply b.obj", "b.obj: cannot write that; choose .ply, .4dgs, .html, .usd* or .blend."),
        ("a.ply b.mp4", "b.mp4: films are made by `timesplat video`"),
        ("a.ply b.sog", "b.sog: .sog holds one moment; say which by --frame."),
        ("a.ply b.4dgs --frame 3", "the name of a slice must end in .ply, .splat, .spz, .sog, .glb"),
        ("b.ply c.ply", "b.ply: no such file"),
    ],
)
def test_what_does_not_go_together_is_a_sentence(asset, tmp_path, monkeypatch, capsys, words, says):
    monkeypatch.chdir(tmp_path)
    assert export(*words.split()) == 2
    err = capsys.readouterr().err
    assert says in err and len(err.strip().splitlines()) == 1
    assert [p.name for p in tmp_path.iterdir()] == ["a.ply"]


def test_help_names_every_format():
    for add in (add_export_arguments, add_view_arguments):
        parser = argparse.ArgumentParser()
        add(parser)
        said = " ".join(parser.format_help().split())
        for suffix in READABLE:
            assert (".usd*" if suffix.startswith(".usd") else suffix) in said
    for suffix in (*WRITABLE, *SLICE_FORMATS):
        assert (".usd*" if suffix.startswith(".usd") else suffix) in said or add is add_view_arguments


def test_a_page_is_opened_upright(asset, tmp_path, monkeypatch):
    opened = []
    monkeypatch.setattr("webbrowser.open", lambda url: opened.append(url) or True)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert export(tmp_path / "a.ply", tmp_path / "m.sog", "--frame", 5) == 0
    assert main(["view", str(tmp_path / "m.sog")]) == 0
    (page,) = tmp_path.glob("timesplat-*/m.html")
    loaded = read_asset(page)
    assert loaded.up == "Z" and page.as_uri() == opened[0]
    assert_stands(world(upright(loaded), 1), world(asset, 5))
