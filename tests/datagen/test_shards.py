# SPDX-License-Identifier: GPL-3.0-or-later
"""Shards: what comes back is what was rendered, and a run that is cut off ends as one that is not."""

import csv
import json
import shutil
import tarfile
from dataclasses import replace

import numpy as np
import pytest

from timesplat.cli import main
from timesplat.datagen import shards
from timesplat.datagen.curation.curate import curate
from timesplat.datagen.curation.decisions import read_decisions, write_decisions
from timesplat.datagen.sequence import InputError, read_sequence
from timesplat.datagen.shards import MANIFEST, PNG, PackedSequence, PackSettings, pack, read_manifest


@pytest.fixture
def data(sphere_folder, tmp_path):
    """Five copies of a Sequence with passes, of which the first says whose it is."""
    folder = tmp_path / "data"
    for name in "abcde":
        shutil.copytree(sphere_folder, folder / name / "walk.v2")
    about = folder / "a/walk.v2/transforms.json"
    d = json.loads(about.read_text())
    d["provenance"] |= {"licence": "CC-BY-4.0", "author": "Ann, of Ülm"}
    about.write_text(json.dumps(d))
    return folder


def contents(folder):
    return {f.name: f.read_bytes() for f in sorted(folder.iterdir())}


@pytest.mark.parametrize("form", shards.FORMATS)
def test_what_comes_back_is_what_was_rendered(data, tmp_path, form):
    clips = pack(data, tmp_path / "out", PackSettings(pictures=form, clips=2))
    assert sorted(c.name for c in clips) == [f"{n}/walk.v2" for n in "abcde"] and len({c.shard for c in clips}) == 3
    assert str(read_manifest(tmp_path / "out" / MANIFEST)) == str(clips)  # NaN, its motion, is not itself
    assert not list(tmp_path.glob("out/.*"))
    for clip in clips:
        seq, packed = read_sequence(data / clip.name), PackedSequence.open(tmp_path / "out", clip)
        assert packed.provenance == seq.provenance and clip.views == len(packed.views) == len(seq.views)
        for theirs, ours in zip(packed.cameras(), seq.cameras(), strict=True):
            np.testing.assert_array_equal(theirs, ours)
        for i in (0, len(seq.views) - 1):
            np.testing.assert_array_equal(packed.load_image(i), seq.load_image(i))
            for name, pixels in vars(seq.load_passes(i)).items():
                np.testing.assert_array_equal(getattr(packed.load_passes(i), name), pixels)


def test_the_licence_stays_with_every_clip(data, tmp_path):
    pack(data, tmp_path / "out")
    with open(tmp_path / "out" / MANIFEST, newline="") as f:
        (row,) = [r for r in csv.DictReader(f) if r["name"] == "a/walk.v2"]
    assert (row["licence"], row["author"]) == ("CC-BY-4.0", "Ann, of Ülm")
    with tarfile.open(tmp_path / "out/shard-000000.tar") as tar:
        about = json.load(tar.extractfile("a_walk_v2.json"))
    assert about["provenance"]["author"] == "Ann, of Ülm" and about["set"] in ("hq4d", "4d", "3d")


def test_webdataset_reads_them(data, tmp_path):
    webdataset = pytest.importorskip("webdataset")
    clips = pack(data, tmp_path / "out")
    found = {s["__key__"]: s for s in webdataset.WebDataset(str(tmp_path / "out/shard-000000.tar"), shardshuffle=False)}
    assert set(found) == {c.key for c in clips}
    sample = found["b_walk_v2"]
    seq = read_sequence(data / "b/walk.v2")
    about = json.loads(sample["json"])
    assert len(about["frames"]) == len(seq.views) and len([k for k in sample if k.endswith(".exr")]) == len(seq.views)
    for view, frame in zip(seq.views, about["frames"], strict=True):
        assert sample[frame["exr_path"]] == (seq.folder / view.passes).read_bytes()
        assert sample[frame["file_path"]][8:12] == b"WEBP"


def test_pictures_alone(data, tmp_path):
    whole = pack(data, tmp_path / "whole")
    clips = pack(data, tmp_path / "out", PackSettings(passes=False))
    assert all(c.passes for c in whole) and not any(c.passes for c in clips)
    sizes = [(tmp_path / name / "shard-000000.tar").stat().st_size for name in ("out", "whole")]
    assert sizes[0] < sizes[1]
    with pytest.raises(InputError, match="walk_v2 was packed without passes"):
        PackedSequence.open(tmp_path / "out", clips[0]).load_passes(0)


def test_cut_off_and_started_again_it_ends_with_the_same_bytes(data, tmp_path, monkeypatch):
    pack(data, tmp_path / "whole", PackSettings(clips=2))
    write, calls = shards._write_shard, []

    def killed(path, *args):
        calls.append(path.name)
        if len(calls) == 2:
            path.with_name(f".{path.name}.tmp").write_bytes(b"half")
            raise KeyboardInterrupt
        return write(path, *args)

    with monkeypatch.context() as m:
        m.setattr(shards, "_write_shard", killed)
        with pytest.raises(KeyboardInterrupt):
            pack(data, tmp_path / "out", PackSettings(clips=2))
        assert not (tmp_path / "out" / MANIFEST).exists()
        pack(data, tmp_path / "out", PackSettings(clips=2))
        assert calls.count("shard-000000.tar") == 1  # what was done is kept
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")


def test_what_changed_is_packed_anew_and_what_is_gone_leaves(data, tmp_path, monkeypatch):
    settings, out = PackSettings(clips=2), tmp_path / "out"
    clips = pack(data, out, settings)
    written, write = [], shards._write_shard
    monkeypatch.setattr(shards, "_write_shard", lambda path, *a: (written.append(path.name), write(path, *a))[1])
    assert str(pack(data, out, settings)) == str(clips) and written == []
    about = data / clips[2].name / "transforms.json"
    about.write_text(about.read_text().replace("CC-BY", "CC-BY-NC") + " ")
    pack(data, out, settings, jobs=2)
    assert written == [clips[2].shard]
    pack(data, out, PackSettings(clips=2, pictures=PNG))
    assert len(written) == 1 + 3
    for name in "abc":
        shutil.rmtree(data / name)
    assert sorted(c.name[0] for c in pack(data, out, settings)) == ["d", "e"]
    assert sorted(f.name for f in out.iterdir()) == [MANIFEST, "shard-000000.csv", "shard-000000.tar"]


def test_curation_counts(data, tmp_path):
    curate(data, report=print)
    rows = read_decisions(data / "curation.csv")
    chosen = {name: "3d" if name in "ab" else "out" for name in "abcde"}
    write_decisions(data / "curation.csv", [replace(r, override=chosen[r.sequence[0]]) for r in rows])
    assert sorted((c.name[0], c.set) for c in pack(data, tmp_path / "out")) == [("a", "3d"), ("b", "3d")]


def test_a_sequence_that_cannot_be_read_is_named_and_the_others_are_packed(data, tmp_path, capsys):
    next((data / "c/walk.v2/images").iterdir()).write_bytes(b"no picture")
    assert main(["pack", str(data), "--out", str(tmp_path / "out"), "--jobs", "1"]) == 2
    said = capsys.readouterr()
    assert "c/walk.v2/images" in said.err and "4 clips" in said.out and "1 Sequences left out" in said.out
    assert sorted(c.name[0] for c in read_manifest(tmp_path / "out" / MANIFEST)) == list("abde")


def test_bad_input_is_a_sentence(data, tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    assert main(["pack", str(tmp_path / "empty"), "--out", str(tmp_path / "x")]) == 2
    assert "there is no Sequence to pack" in capsys.readouterr().err and not (tmp_path / "x").exists()
    assert main(["pack", str(data), "--out", str(tmp_path / "x"), "--clips", "0"]) == 2
    assert "--clips 0" in capsys.readouterr().err
    (clip, *_) = pack(data, tmp_path / "out")
    tar = tmp_path / "out" / clip.shard
    whole = tar.read_bytes()
    tar.write_bytes(whole[: clip.offset + 100])
    with pytest.raises(InputError, match=r"shard-000000\.tar: it ends within"):
        PackedSequence.open(tmp_path / "out", clip)
    tar.write_bytes(whole[: clip.offset] + b"\0" * 100 + whole[clip.offset + 100 :])
    with pytest.raises(InputError, match="is damaged in it"):
        PackedSequence.open(tmp_path / "out", clip)
    tar.unlink()
    with pytest.raises(InputError, match="the shard cannot be read"):
        PackedSequence.open(tmp_path / "out", clip)
    (tmp_path / "out" / MANIFEST).write_text("name\nx\n")
    with pytest.raises(InputError, match=r"manifest\.csv: it is damaged"):
        read_manifest(tmp_path / "out" / MANIFEST)


def test_keys_are_short_and_distinct(data, tmp_path):
    long = "x" * 120 + "/" + "é" * 20
    shutil.copytree(data / "a", data / long)
    shutil.copytree(data / "a" / "walk.v2", data / "a_walk" / "v2")
    clips = pack(data, tmp_path / "out", PackSettings(passes=False))
    keys = [c.key for c in clips]
    assert len({*keys}) == 7 and all(len(k) <= 63 and k.isascii() and "." not in k for k in keys)
    assert {"a_walk_v2", "a_walk_v2-2"} <= {*keys}
