# SPDX-License-Identifier: GPL-3.0-or-later
import argparse
import json
import os
import random
import shutil
import signal
import sys
import time
from dataclasses import replace

import bpy
import numpy as np
import pyarrow.parquet
import pytest

from timesplat.datagen import farm
from timesplat.datagen.farm import render_assets, render_shots
from timesplat.datagen.licences import Licences
from timesplat.datagen.readers import sequences_in
from timesplat.datagen.render_index import Row, join_index, read_index
from timesplat.datagen.render_job import Part, RenderSettings
from timesplat.datagen.scene.open import empty_session
from timesplat.datagen.sequence import InputError, read_sequence

from .killing import KILLS, ZOO, everything, survives
from .writers.conftest import make as make_sequence

SMALL = RenderSettings(rig="alternating", frames=4, size=24, samples=1)


@pytest.fixture(scope="module")
def assets(small_assets):
    return small_assets


def test_a_folder_of_assets(assets, tmp_path):
    said, counts = [], []
    licences = Licences([{"name": "still", "licence": "CC0-1.0", "author": "Ann"}])
    folders, failures = render_assets(
        *([str(assets)], tmp_path, SMALL),
        jobs=2,
        licences=licences,
        report=said.append,
        progress=lambda *n: counts.append(n),
    )
    assert {f.relative_to(tmp_path).as_posix() for f in folders} == {"moving/long-way", "still/static"}
    assert failures == said and len(said) == 1 and "cut.glb" in said[0] and said[0].endswith(".")
    assert counts[0] == (0, 3, 0) and counts[-1] == (3, 3, 5)
    seq = read_sequence(tmp_path / "moving" / "long-way")
    assert [v.camera for v in seq.views] == ["front", "left", "back", "right"] and seq.frame_end == 3
    p = seq.provenance
    assert p["asset"] == "moving.glb" and len(p["sha256"]) == 64 and p["clip"] == "long way"
    assert p["scene_frames"] == [0, 1, 2, 3] and p["blender"].startswith(str(bpy.app.version[0]))
    assert p["settings"]["samples"] == 1
    assert np.isfinite(seq.load_passes(0).depth).any() and seq.load_image(0)[..., 3].any()
    assert len(seq.load_tracks()) == 4000 and seq.untracked == []
    still = read_sequence(tmp_path / "still" / "static")
    assert (still.frame_start, still.frame_end, len(still.views)) == (0, 0, 1)
    assert not list(tmp_path.rglob(".*"))
    cut, moving, quiet = rows = read_index(tmp_path)
    assert (cut.name, cut.sequence, cut.status, cut.sentence) == ("cut", "", "refused", said[0])
    assert len(cut.sha256) == 64 and cut.seconds > 0 and cut.cpu_seconds > 0.1 and cut.pictures == 0
    assert (moving.pictures, quiet.pictures) == (4, 1)
    assert all(0.3 < row.cpu_seconds < 60 for row in (moving, quiet))  # Blender alone takes half a second to start
    assert (moving.sequence, moving.source, moving.clip) == ("moving/long-way", "moving.glb", "long way")
    assert (moving.sha256, moving.camera_seed, moving.seconds) == (p["sha256"], p["cameras_seed"], p["seconds"])
    assert (quiet.licence, quiet.author, quiet.uid, moving.licence) == ("CC0-1.0", "Ann", "still", "")
    assert (still.provenance["licence"], still.provenance["author"]) == ("CC0-1.0", "Ann")
    table = pyarrow.parquet.read_table(tmp_path / "index.parquet").to_pylist()
    assert [Row(**row) for row in table] == rows

    start = time.monotonic()  # once more: nothing is opened, what failed is told again, and the table stays as it is
    before = (tmp_path / "index.parquet").read_bytes()
    again, failed = render_assets([str(assets)], tmp_path, SMALL, licences=licences, retry=False, report=said.append)
    assert (
        sorted(again) == sorted(folders) and failed == said[:1] == said[1:] and time.monotonic() - start < cut.seconds
    )
    assert (tmp_path / "index.parquet").read_bytes() == before
    other = Licences([{"name": "moving", "licence": "MIT"}])
    render_assets([str(assets / "moving.glb")], tmp_path, SMALL, root=assets, licences=other)
    assert [r.licence for r in read_index(tmp_path)] == ["", "MIT", "CC0-1.0"]
    assert read_sequence(tmp_path / "moving" / "long-way").provenance["licence"] == "MIT"


def test_machines_that_share_a_folder_render_each_asset_once(assets, tmp_path):
    everyone = [str(assets), "zoo:3"]
    parts = [Part(number, 3) for number in (1, 2, 3)]
    settings = replace(SMALL, passes=False, tracks="none", frames=1)
    by_part = [render_assets(everyone, tmp_path / "parts", settings, part=p, report=str)[0] for p in parts]
    told = [read_index(tmp_path / "parts", p) for p in parts]
    assert sorted(row.name for rows in told for row in rows) == ["cut", "moving", "still", "zoo-000003"]
    assert sum(map(bool, told)) > 1 and len({f for folders in by_part for f in folders}) == 3
    rows = join_index(tmp_path / "parts")
    render_assets(everyone, tmp_path / "whole", settings, report=str)
    joined, whole = (everything(tmp_path / name) for name in ("parts", "whole"))
    assert {name: data for name, data in joined.items() if "index-" not in name} == whole
    assert rows == read_index(tmp_path / "parts")


def test_a_second_run_renders_only_what_is_missing(assets, tmp_path):
    both = [str(assets / "moving.glb"), str(assets / "still.glb")]
    settings = replace(SMALL, clip="all", passes=False)
    first, _ = render_assets(both, tmp_path, settings)
    assert len(first) == 3
    times = {f: (f / "transforms.json").stat().st_mtime_ns for f in first}
    (first[0] / "images").rename(first[0] / "gone")
    again, failures = render_assets(both, tmp_path, settings)
    assert sorted(again) == sorted(first) and not failures
    changed = [f for f in first if (f / "transforms.json").stat().st_mtime_ns != times[f]]
    assert changed == [first[0]]
    other, _ = render_assets(both[1:], tmp_path, replace(settings, samples=2))
    assert (other[0] / "transforms.json").stat().st_mtime_ns != times[other[0]]


def test_a_long_animation_in_consecutive_clips_and_spread(assets, tmp_path):
    small = replace(SMALL, passes=False, tracks="none", clip="long way")
    asset = [str(assets / "moving.glb")]
    cut = replace(small, clips="consecutive", every=2, frames=2)
    folders, _ = render_assets(asset, tmp_path / "cut", cut)
    assert sorted(f.name for f in folders) == ["long-way-01", "long-way-02", "long-way-03"]
    said = [read_sequence(f).provenance for f in sorted(folders)]
    assert [p["scene_frames"] for p in said] == [[0, 2], [4, 6], [8, 10]]
    assert len({p["cameras_seed"] for p in said}) == 3
    times = [f.stat().st_mtime_ns for f in folders]
    again, _ = render_assets(asset, tmp_path / "cut", cut)
    assert sorted(again) == sorted(folders) and [f.stat().st_mtime_ns for f in folders] == times
    (folder,), _ = render_assets(asset, tmp_path / "spread", replace(small, spread=True))
    seq = read_sequence(folder)
    assert np.allclose(seq.provenance["scene_frames"], [0, 10 / 3, 20 / 3, 10]) and seq.fps == pytest.approx(
        24 * 3 / 10
    )


def test_still_objects_displaced(assets, tmp_path):
    settings = replace(SMALL, displace=True, rig="canonical")
    (folder,), _ = render_assets([str(assets / "still.glb")], tmp_path, settings)
    seq = read_sequence(folder)
    assert seq.frame_end == 3 and len(seq.views) == 16
    p = seq.load_passes(seq.select(camera="front", frame=1)[0])
    flow = p.flow_next[np.isfinite(p.depth)]
    assert np.abs(flow).max() > 0.1


def test_shots_of_a_setup_with_targets(assets, tmp_path):
    seen = []
    seq = render_shots(
        str(assets / "moving.glb"),
        tmp_path / "here",
        "interpolation",
        replace(SMALL, targets=2, clip="short way"),
        progress=lambda *n: seen.append(n),
    )
    assert seq.root == tmp_path / "here" and seq.provenance["clip"] == "short way"
    assert len(seq.select(rig="interpolation")) == 4 and len(seq.select(rig="target")) == 8
    assert seen[-1] == (12, 12)
    with pytest.raises(InputError, match=r"no clip named x; it has .*short way"):
        render_shots(str(assets / "moving.glb"), tmp_path / "x", "random", replace(SMALL, clip="x"))
    with pytest.raises(InputError, match=r"cut off"):
        render_shots(str(assets / "cut.glb"), tmp_path / "x", "random", SMALL)


def test_the_zoo(tmp_path):
    a, _ = render_assets(["zoo:7"], tmp_path / "a", SMALL)
    b = render_shots("zoo:7", tmp_path / "b", "alternating", SMALL)
    assert [f.relative_to(tmp_path).as_posix() for f in a] == ["a/zoo-000007/zoo"]
    assert b.provenance["zoo"]["seed"] == 7
    assert all(np.array_equal(read_sequence(a[0]).load_image(i), b.load_image(i)) for i in range(4))


def test_two_assets_of_one_name(assets, tmp_path):
    (tmp_path / "still.glb").write_bytes((assets / "still.glb").read_bytes())
    both = [str(assets / "still.glb"), str(tmp_path / "still.glb")]
    folders, failures = render_assets(both, tmp_path / "out", SMALL, report=lambda s: None)
    assert len(folders) == 1 and len(failures) == 1 and "rename" in failures[0]


@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_a_child_that_dies_is_one_sentence(assets, tmp_path, monkeypatch):
    dying = tmp_path / "python"
    dying.write_text("#!/bin/sh\necho 'last words' > \"$4\"\nkill -SEGV $$\n")
    dying.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(dying))
    half = tmp_path / "out" / "still" / ".static.abc"
    half.mkdir(parents=True)
    folders, failures = render_assets([str(assets / "still.glb")], tmp_path / "out", SMALL, report=print)
    assert not half.exists()
    assert not folders and len(failures) == 1
    assert "signal 11" in failures[0] and "last words" in failures[0] and "still.glb" in failures[0]
    (row,) = read_index(tmp_path / "out")
    assert (row.status, row.sentence) == ("crashed", failures[0])
    with pytest.raises(InputError, match="signal 11"):
        render_shots(str(assets / "still.glb"), tmp_path / "x", "random", SMALL)


# ---------------------------------------------------------------- killed, and started again


@pytest.mark.skipif(sys.platform != "linux", reason="signals, /proc")
@pytest.mark.parametrize("kills", [2, pytest.param(KILLS, marks=pytest.mark.slow)])
def test_killed_at_any_moment_it_ends_with_the_same(assets, tmp_path, kills):
    def kill(process, number):
        """The whole group, or the parent alone, whose children have to notice."""
        (os.killpg if number % 2 else os.kill)(process.pid, signal.SIGKILL)
        process.wait()
        return 1

    assert survives([assets, *ZOO[: kills // 3]], tmp_path, kills, random.Random(kills), kill)


# ---------------------------------------------------------------- what is not as it should be


@pytest.fixture(scope="module")
def odd(tmp_path_factory):
    """A folder with two assets of one name, one of which is tiny and the other huge, both flying; and a .blend whose
    motion is a script."""
    folder = tmp_path_factory.mktemp("odd")
    for name, size in (("ant", 1e-7), ("moon", 1e8)):
        empty_session()
        bpy.ops.mesh.primitive_cube_add(size=2 * size)
        for frame in (0, 10):
            bpy.context.object.location = (frame / 10 * size, 0, 0)
            bpy.context.object.keyframe_insert("location", frame=frame)
        (folder / name).mkdir()
        bpy.ops.export_scene.gltf(filepath=str(folder / name / "scene.gltf"), export_format="GLTF_SEPARATE")
    empty_session()
    bpy.ops.mesh.primitive_cube_add()
    bpy.context.object.driver_add("location", 2).driver.expression = "__import__('math').sin(frame)"
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "script.blend"))
    return folder


def test_the_tiny_the_huge_and_what_is_said_of_a_script(odd, tmp_path):
    said = []
    settings = replace(SMALL, frames=3, tracks="none")
    folders, failures = render_assets([str(odd)], tmp_path, settings, report=said.append)
    assert not failures and len(folders) == 3
    ant, moon = (next((tmp_path / name / "scene").glob("*")) for name in ("ant", "moon"))
    sizes = [read_sequence(f).normalisation.scale for f in (ant, moon)]
    assert sizes[1] / sizes[0] == pytest.approx(1e15, rel=0.1) and 1e-7 < sizes[0] < 3e-7
    for folder in (ant, moon):
        seq = read_sequence(folder)
        p, alpha = seq.load_passes(0), seq.load_image(0)[..., 3] / 255
        assert alpha.mean() > 0.2 and np.nanmin(p.depth) == pytest.approx(1.9, abs=0.4)
        assert np.abs(p.flow_next[alpha == 1][:, 0]).max() > 0.2
    a, b = (read_sequence(f).load_image(0).astype(float) for f in (ant, moon))
    assert np.abs(a - b).mean() < 20  # but for noise, whose seed is of the name
    told = read_sequence(tmp_path / "script" / "scene").provenance["warnings"]
    assert (
        told == said
        and ["scripted drivers of Cube" in said[0], "nothing moves in frames 1 to 3" in said[1]] == [True] * 2
    )


def test_a_root_that_was_forgotten_is_rendered_again(odd, tmp_path):
    asset, settings = str(odd / "ant" / "scene.gltf"), replace(SMALL, frames=1, passes=False, tracks="none")
    (folder,), _ = render_assets([asset], tmp_path, settings)
    assert folder.parent == tmp_path / "scene" and read_sequence(folder).provenance["path"] == "scene.gltf"
    (below,), _ = render_assets([asset], tmp_path, settings, root=odd)
    assert below.parent == tmp_path / "ant" / "scene"
    shutil.copytree(below.parent, tmp_path / "scene", dirs_exist_ok=True)
    before = (folder / "transforms.json").stat().st_mtime_ns
    render_assets([asset], tmp_path, settings)
    assert (folder / "transforms.json").stat().st_mtime_ns != before


def arguments(*words):
    parser = argparse.ArgumentParser()
    farm.add_arguments(parser)
    return parser.parse_args([str(w) for w in words])


def test_the_command_line(assets, tmp_path, capsys):
    small = ["--out", tmp_path, "--size", 24, "--samples", 1, "--frames", 2, "--rig", "random", "--no-passes"]
    assert farm.run(arguments(assets / "still.glb", *small)) == 0
    assert farm.run(arguments(assets / "still.glb", tmp_path / "no.glb", *small)) == 2
    text = capsys.readouterr()
    assert "1 sequences" in text.out and "1 failed" in text.out and "no such file" in text.err
    made = json.loads((tmp_path / "still" / "static" / "transforms.json").read_text())
    assert "exr_path" not in made["frames"][0] and made["w"] == 24 and made["tracks_path"] == "tracks.npz"
    assert farm.run(arguments(assets / "still.glb", *small, "--tracks", "none")) == 0
    made = json.loads((tmp_path / "still" / "static" / "transforms.json").read_text())
    assert "tracks_path" not in made and not (tmp_path / "still" / "static" / "tracks.npz").exists()
    for wrong in (
        small,
        [tmp_path / "still" / "static" / "images", *small],
        ["--zoo", "1-x", *small],
        [assets, *small, "--size", 4],
        [assets, *small, "--samples", 0],
        [assets, *small, "--tracks", "some"],
    ):
        with pytest.raises(InputError, match=r"^[^\n]*;[^\n]*\.$"):
            farm.run(arguments(*wrong))


def test_no_graphics_card_is_said(assets, tmp_path):
    try:
        seq = render_shots(str(assets / "still.glb"), tmp_path / "x", "random", replace(SMALL, device="GPU"))
    except InputError as e:
        assert "no graphics card" in str(e) and "--device CPU" in str(e)
    else:
        assert seq.load_image(0)[..., 3].any()


def test_seeds():
    assert farm.parse_seeds("0-3, 7,9-9") == [0, 1, 2, 3, 7, 9] and farm.parse_seeds(None) == []


def test_in_another_programs_layout(tmp_path, monkeypatch, capsys):
    """The Sequences, from which a run goes on, are kept in a hidden folder; what is done is not done again."""
    made = []

    def render(assets, out, *_, **__):
        folder = out / "box/run"
        if not folder.exists():
            make_sequence(folder, moments=2)
            made.append(folder)
        return [folder], []

    monkeypatch.setattr(farm, "render_assets", render)
    command = arguments("box.glb", "--out", str(tmp_path / "out"), "--layout", "nerfstudio")
    assert farm.run(command) == 0 and "1 sequences in" in capsys.readouterr().out
    written = tmp_path / "out/box/run/transforms.json"
    first = written.stat()
    assert "format" not in json.loads(written.read_text()) and made == [tmp_path / "out/.sequences/box/run"]
    assert sequences_in(tmp_path / "out") == [tmp_path / "out/box/run"]
    assert farm.run(command) == 0 and written.stat().st_mtime_ns == first.st_mtime_ns and len(made) == 1
