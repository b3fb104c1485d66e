# SPDX-License-Identifier: GPL-3.0-or-later
"""One door to every kind of Sequence folder."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from timesplat.datagen.readers import described_by, name_of, open_sequence, sequences_in
from timesplat.datagen.readers.options import ReadOptions
from timesplat.datagen.sequence import InputError

from .worlds import PLAIN, shots, write_colmap, write_panoptic, write_pictures, write_transforms


def test_each_folder_finds_its_reader(sphere_folder, write_dnerf):
    ours, others = open_sequence(sphere_folder), open_sequence(write_dnerf())
    assert ours.views[0].rig == "input" and others.views[0].rig == "train"
    shutil.copy(sphere_folder / "transforms.json", others.root)  # its own format comes first: that has all there is
    with pytest.raises(InputError, match=r"images/000\.png: the file is missing; render the Sequence again"):
        open_sequence(others.root)


def test_what_is_neither_is_told_what_is_read(tmp_path):
    with pytest.raises(
        InputError, match=r"transforms\.json: no such file, nor transforms_train\.json, .* give a folder"
    ):
        open_sequence(tmp_path)


def test_found_at_any_depth_but_only_when_finished(tmp_path):
    for name in ("b/walk", "a", "a/deeper/run", ".c.x7/half", "b/.walk.y8", "empty", "dnerf/jumping"):
        (tmp_path / name).mkdir(parents=True)
        if name != "empty":
            (tmp_path / name / ("transforms_train.json" if "dnerf" in name else "transforms.json")).touch()
    assert sequences_in(tmp_path) == [tmp_path / name for name in ("a", "a/deeper/run", "b/walk", "dnerf/jumping")]
    assert sequences_in(tmp_path / "b" / "walk") == [tmp_path / "b" / "walk"]
    assert sequences_in(tmp_path / "nowhere") == []
    assert [name_of(tmp_path / name) for name in ("b/walk", "dnerf/jumping")] == ["b", "jumping"]


def test_what_describes_a_sequence(sphere_folder, write_dnerf):
    assert described_by(sphere_folder) == [sphere_folder / "transforms.json"]
    folder = write_dnerf()
    assert [p.name for p in described_by(folder)] == [f"transforms_{s}.json" for s in ("train", "val", "test")]
    (folder / "transforms_val.json").unlink()
    assert [p.name for p in described_by(folder)] == [f"transforms_{s}.json" for s in ("train", "test")]
    assert described_by(folder / "train") == []


@pytest.fixture
def as_dnerf(sphere_folder, tmp_path):
    """The spheres' Sequence rewritten as D-NeRF: what is held out is its test split."""
    folder = shutil.copytree(sphere_folder, tmp_path / "spheres", ignore=shutil.ignore_patterns("passes"))
    d = json.loads((folder / "transforms.json").read_text())
    (folder / "transforms.json").unlink()
    for split, rig in (("train", "input"), ("test", "target")):
        keys = ("file_path", "time", "transform_matrix")
        frames = [{k: f[k] for k in keys} for f in d["frames"] if f["rig"] == rig]
        for f in frames:
            f["file_path"] = "./" + f["file_path"].removesuffix(".png")
        told = {"camera_angle_x": 0.8726646259971648, "frames": frames}  # 50 degrees
        (folder / f"transforms_{split}.json").write_text(json.dumps(told))
    return folder


def test_a_sequence_rewritten_is_the_same(sphere_folder, as_dnerf):
    ours, again = open_sequence(sphere_folder), open_sequence(as_dnerf)
    assert len(again.views) == len(ours.views) == 30 and again.frame_end == ours.frame_end
    for i, (a, b) in enumerate(zip(ours.views, again.views, strict=True)):
        assert again.normalisation.to_world(b.c2w) == pytest.approx(a.c2w, abs=1e-6)
        assert (b.frame, type(b.frame), b.cx, b.cy) == (a.frame, int, a.cx, a.cy) and b.fx == pytest.approx(a.fx)
        assert (again.load_image(i) == ours.load_image(i)).all()


def test_it_is_evaluated_and_reconstructed(as_dnerf, tmp_path, capsys):
    pytest.importorskip("torch")
    from timesplat.cli import main
    from timesplat.model.io.ply import read_ply

    out = tmp_path / "out"
    command = ["evaluate", str(as_dnerf), "--setup", "split", "--size", "16", "--methods", "white,hull"]
    assert main([*command, "--out", str(out)]) == 0
    rows = [json.loads(x) for x in (out / "rows.jsonl").read_text().splitlines()]
    assert [(r["object"], r["method"], r["views"], r["size"]) for r in rows] == [
        ("spheres", "white", 24, 16),
        ("spheres", "hull", 24, 16),
    ]
    assert len(rows[0]["frames"]["psnr"]) == 6 and rows[1]["psnr_fg"] > rows[0]["psnr_fg"] + 2
    ply = tmp_path / "a.ply"
    assert main(["reconstruct", str(as_dnerf), "--method", "hull", "--size", "16", "--out", str(ply)]) == 0
    assert "from 24 views" in capsys.readouterr().out
    clip = read_ply(ply).clip
    assert (clip.frame_start, clip.frame_end, clip.fps) == (0, 23, 24) and clip.scale == pytest.approx(1.259, abs=1e-3)


@pytest.mark.parametrize("command", ["reconstruct", "evaluate"])
def test_bad_input_is_a_sentence_and_exit_code_2(as_dnerf, tmp_path, capsys, command):
    from timesplat.cli import main

    path = as_dnerf / "transforms_train.json"
    good = json.loads(path.read_text())
    words = {"reconstruct": ["--method", "hull"], "evaluate": ["--setup", "split", "--methods", "white"]}[command]
    changes = {
        "camera_angle_x": {"frames": good["frames"]},
        "no frames": good | {"frames": []},
        "singular": good | {"frames": [good["frames"][0] | {"transform_matrix": [[0.0] * 4] * 4}]},
        "no.png: the file is missing": good | {"frames": [good["frames"][0], good["frames"][1] | {"file_path": "no"}]},
        "do not shrink to 24": good,
    }
    for says, d in changes.items():
        path.write_text(json.dumps(d))
        size = ["--size", "24" if d is good else "16"]
        assert main([command, str(as_dnerf), "--out", str(tmp_path / "out.ply"), *words, *size]) == 2
        told = capsys.readouterr().err.strip().splitlines()
        assert says in told[-1] and told[-1].startswith("timesplat: ") and not (tmp_path / "out.ply").exists()


def test_layouts_of_others_are_found_and_named(tmp_path):
    taken = shots(4)
    for name in ("fox", "tree/colmap"):
        write_pictures(tmp_path / name, taken)
    write_transforms(tmp_path / "fox", taken)
    write_colmap(tmp_path / "fox" / "colmap", taken, ["0000.png"] * 4)  # that it was made from: not another scene
    write_colmap(tmp_path / "tree" / "colmap", taken, [f"{k:04d}.png" for k in range(4)])
    rig = [[replace(s, camera=str(k)) for k, s in enumerate(taken)]]
    write_panoptic(tmp_path / "ball", rig)
    folders = [tmp_path / "ball", tmp_path / "fox", tmp_path / "tree"]
    assert sequences_in(tmp_path) == folders
    assert [name_of(f) for f in folders] == ["ball", "fox", "tree"]
    assert [[p.name for p in described_by(f)] for f in folders] == [
        ["train_meta.json", "test_meta.json"],
        ["transforms.json"],
        ["cameras.txt", "images.txt", "points3D.txt"],
    ]
    with pytest.raises(InputError, match=r"fox/images/0002\.png"):
        (tmp_path / "fox/images/0002.png").unlink()
        open_sequence(tmp_path / "fox")


def test_options_are_for_what_leaves_it_open(sphere_folder, write_dnerf):
    with pytest.raises(InputError, match="--axes is for layouts that leave it open"):
        open_sequence(sphere_folder, ReadOptions(axes="opencv"))
    for options in (ReadOptions(scale=2), ReadOptions(background="white", times="none")):
        with pytest.raises(InputError, match="is for layouts that leave it open"):
            open_sequence(write_dnerf(f"s{options.scale}"), options)


def test_what_is_opened_twice_is_not_shared(tmp_path):
    taken = shots(6)
    write_pictures(tmp_path, taken)
    write_transforms(tmp_path, taken)
    first = open_sequence(tmp_path)
    first.views[0].c2w[:] = 0
    assert open_sequence(tmp_path).views[0].c2w.any()


def test_pictures_on_white_in_the_format_of_d_nerf(write_dnerf):
    folder = write_dnerf()
    picture = np.full((4, 6, 3), 255, np.uint8)
    picture[2, 3] = (200, 20, 20)
    for path in folder.rglob("*.png"):
        Image.fromarray(picture).save(path)
    seq = open_sequence(folder)
    assert (seq.load_image(2)[..., 3] > 0).sum() == 1 and "#ffffff" in seq.provenance["read"][1]
    black = open_sequence(folder, ReadOptions(background="black")).load_image(2)
    assert (black[..., 3] == 255).all()


def test_a_folder_of_others_is_reconstructed_and_evaluated(tmp_path, capsys):
    """With the folder alone; what was done is said."""
    pytest.importorskip("torch")
    from timesplat.cli import main
    from timesplat.model.io.ply import read_ply

    taken = shots(12, lens=PLAIN.resized(32, 32))
    write_pictures(tmp_path / "scene", taken, white=True)
    names = [f"images/{k:04d}.png" for k in range(12)]
    write_transforms(tmp_path / "scene", taken, test_filenames=names[9:])
    ply = tmp_path / "a.ply"
    assert main(["reconstruct", str(tmp_path / "scene"), "--method", "hull", "--out", str(ply)]) == 0
    said = capsys.readouterr().out
    assert "measured there" in said and "visual hull" in said and "from 9 views" in said
    assert len(read_ply(ply)) > 10
    words = ["--setup", "split", "--size", "16", "--methods", "white,hull", "--out", str(tmp_path / "out")]
    assert main(["evaluate", str(tmp_path / "scene"), *words]) == 0
    rows = [json.loads(x) for x in (tmp_path / "out" / "rows.jsonl").read_text().splitlines()]
    assert [(r["object"], len(r["frames"]["psnr"])) for r in rows] == [("scene", 3)] * 2
    assert main(["reconstruct", str(tmp_path / "scene"), "--axes", "unity", "--out", str(ply)]) == 2


def test_what_is_said_of_a_folder_counts_in_every_command(tmp_path, capsys):
    """Cameras with other axes: evaluate and train read them as --axes says, and refuse them without."""
    pytest.importorskip("torch")
    from timesplat.cli import main
    from timesplat.datagen.sequence import opengl_to_opencv
    from timesplat.model.training.dataset import ClipDataset

    taken = shots(12, lens=PLAIN.resized(32, 32))
    write_pictures(tmp_path / "scene", taken)
    turned = lambda k, s: {"transform_matrix": opengl_to_opencv(s.c2w).tolist()}  # noqa: E731
    write_transforms(tmp_path / "scene", taken, frame=turned, test_filenames=["images/0009.png"])
    words = ["evaluate", str(tmp_path / "scene"), "--setup", "split", "--size", "16", "--methods", "white,hull"]
    assert main([*words, "--out", str(tmp_path / "no")]) == 2 and "do not look at one object" in capsys.readouterr().err
    assert main([*words, "--axes", "opencv", "--out", str(tmp_path / "yes")]) == 0
    rows = [json.loads(x) for x in (tmp_path / "yes/rows.jsonl").read_text().splitlines()]
    assert {r["method"]: len(r["frames"]["psnr"]) for r in rows} == {"white": 1, "hull": 1}
    with pytest.raises(InputError, match="do not look at one object"):
        ClipDataset([tmp_path / "scene"], tmp_path / "packed", has_depth=False)
    told = ClipDataset([tmp_path / "scene"], tmp_path / "packed", has_depth=False, reading=ReadOptions(axes="opencv"))
    assert len(told.paths) == 1
