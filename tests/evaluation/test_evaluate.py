"""The instrument: what metrics.json holds, and that its figures are those of the pictures."""

import hashlib
import json
import re
import shlex
import shutil
from pathlib import Path

import pytest
import torch

from timesplat.cli import main
from timesplat.datagen.sequence import InputError, read_sequence
from timesplat.evaluation import evaluate
from timesplat.evaluation.evaluate import draw, evaluate_folders, evaluate_method, load_inputs, load_truth, parse_method
from timesplat.evaluation.metrics import psnr
from timesplat.evaluation.provenance import ROOT, revision
from timesplat.evaluation.tables import COLUMNS
from timesplat.model.views import load_views


def test_figures_are_those_of_the_pictures(sphere_folder):
    seq = read_sequence(sphere_folder)
    targets = seq.select(rig="target")
    row, g = evaluate_method(seq, "lift", list(range(24)), targets)
    truth = load_views(seq, targets)
    by_hand = psnr(draw(g, truth)[0], truth.over(1.0))
    assert row["psnr"] == pytest.approx(float(by_hand.mean()), abs=1e-5)
    assert row["psnr_worst"] == pytest.approx(float(by_hand.min()), abs=1e-5)
    assert row["gaussians_kept"] == len(g) <= row["gaussians"]


def test_metrics_json_has_the_promised_names(sphere_folder, tmp_path, capsys):
    seq = read_sequence(sphere_folder)
    evaluate_folders({"a": seq, "b": seq}, ["white", "lift"], tmp_path)
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert set(metrics) >= {"methods", "objects", "machine", "versions"}
    assert list(metrics["methods"]) == ["white", "lift"]
    assert set(metrics["objects"]["a"]["lift"]) == set(metrics["methods"]["lift"]) == set(COLUMNS)
    assert metrics["methods"]["lift"]["psnr"] > metrics["methods"]["white"]["psnr"]
    assert metrics["machine"]["cores"] >= 1 and metrics["versions"]["torch"]
    assert "| lift |" in (tmp_path / "metrics.md").read_text() and "| lift |" in capsys.readouterr().out


def test_white_scores_what_the_silhouette_says(sphere_folder):
    seq = read_sequence(sphere_folder)
    targets = seq.select(rig="target")
    row, g = evaluate_method(seq, "white", list(range(24)), targets)
    truth = load_views(seq, targets)
    assert len(g) == 0
    expected = psnr(torch.ones_like(truth.rgb), truth.over(1.0)).mean()
    assert row["psnr"] == pytest.approx(float(expected), abs=1e-5)


class Frozen:
    """A scene that is not Gaussians4D: the state of another at each time."""

    def __init__(self, g):
        self.g = g

    def __len__(self):
        return len(self.g)

    def __getitem__(self, index):
        return Frozen(self.g[index])

    def alive(self):
        return self.g.alive()

    def at(self, t):
        return self.g.frozen(t)


def test_other_moving_scenes_are_scored_as_well(sphere_folder, monkeypatch):
    seq = read_sequence(sphere_folder)
    targets = seq.select(rig="target")
    row, _ = evaluate_method(seq, "lift", list(range(24)), targets)
    plain = evaluate.reconstruct_views
    monkeypatch.setattr(evaluate, "reconstruct_views", lambda *a, **k: Frozen(plain(*a, **k)))
    moving, scene = evaluate_method(seq, "lift", list(range(24)), targets)
    assert isinstance(scene, Frozen) and moving["psnr"] == pytest.approx(row["psnr"], abs=0.05)


def test_smaller_sizes_are_averages(sphere_folder):
    seq = read_sequence(sphere_folder)
    targets = seq.select(rig="target")
    truth, half = load_truth(seq, targets, targets), load_truth(seq, targets, targets[:1], 16)
    assert half.picture.shape == (6, 16, 16, 3) and half.novel.tolist() == [True] + [False] * 5
    blocks = truth.picture.reshape(6, 16, 2, 16, 2, 3).mean((2, 4))
    assert torch.allclose(half.picture, blocks, atol=1e-6)
    assert torch.allclose(half.views.intrinsics * 2, truth.views.intrinsics)
    with_depth, without = (load_inputs(seq, range(24), depth, 16) for depth in (True, False))
    assert torch.equal(with_depth.rgb, without.rgb) and without.depth is None and with_depth.depth is not None
    assert torch.allclose(without.over(1.0), load_truth(seq, range(24), [], 16).picture, atol=1e-5)
    with pytest.raises(InputError, match="do not shrink to 20"):
        load_inputs(seq, range(24), False, 20)


def test_method_specs():
    assert parse_method(" lift").has_depth and not parse_method("sweep").has_depth
    both = parse_method("guided+refine:10+budget:10%+dense")
    assert (both.name, both.refine, both.budget, both.dense) == ("guided", 10.0, "10%", True)
    assert parse_method("lift+budget:auto").budget == "auto" and parse_method("lift+budget:500").refine is None
    for spec, says in (
        ("magic", "no such method"),
        ("lift+fast", "in this order"),
        ("lift+budget:x", "lift..refine:SECONDS"),
        ("lift+budget:5+refine:1", "in this order"),
        ("lift+budget:0%", "a number of Gaussians"),
    ):
        with pytest.raises(InputError, match=says):
            parse_method(spec)


@pytest.fixture
def folders(sphere_folder, tmp_path):
    """Two objects with one Sequence each, and a half-written one."""
    for name in ("a/line", "b/line", "b/.line.tmp"):
        copy = shutil.copytree(sphere_folder, tmp_path / "data" / name) / "transforms.json"
        if name == "b/line":
            copy.write_text(copy.read_text() + " ")  # not the same Sequence
    return tmp_path / "data"


def test_finished_sequences_are_found(folders, tmp_path):
    sequences, others = evaluate.find_sequences([str(folders), "fox.glb"])
    assert list(sequences) == ["a", "b"] and others == ["fox.glb"]
    shutil.copytree(folders / "a" / "line", folders / "a" / "turn")
    assert list(evaluate.find_sequences([str(folders)])[0]) == ["a/line", "a/turn", "b"]


PLAN = {"setups": ("", "alternating"), "sizes": (16, 32), "stride": (8, 4)}


def test_many_runs_go_on_where_they_were(folders, tmp_path, monkeypatch):
    for f in folders.glob("?/line/transforms.json"):
        f.write_text(re.sub(r'"rig": "(?!target)\w*"', '"rig": "alternating"', f.read_text()))
    sequences, _ = evaluate.find_sequences([str(folders)])
    out = tmp_path / "out"
    first = evaluate_folders(sequences, ["white", "lift"], out, command="timesplat evaluate x", **PLAN)
    assert set(first["setups"]) == set(PLAN["setups"]) and set(first["setups"][""]) == {"16", "32"}
    lines = (out / "rows.jsonl").read_text().splitlines()
    assert len(lines) == 2 * 2 * 2 * 2
    text = (out / "tables.md").read_text()
    assert text.startswith("`timesplat evaluate x`\n") and (out / "tables.csv").read_text().startswith("# timesplat e")

    (out / "rows.jsonl").write_text("\n".join(lines[:-1]) + "\n" + lines[-1][:50])
    made = []
    plain = evaluate.evaluate_views
    monkeypatch.setattr(evaluate, "evaluate_views", lambda *a: made.append(a[1]) or plain(*a))
    second = evaluate_folders(sequences, ["white", "lift"], out, command="timesplat evaluate x", **PLAN)
    assert len(made) == 1
    for setup in PLAN["setups"]:
        for size in ("16", "32"):
            a, b = (m["setups"][setup][size]["methods"]["lift"]["psnr"] for m in (first, second))
            assert a == b
    with pytest.raises(InputError, match="allow more"):
        evaluate_folders(sequences, ["hull"], out, deadline=0)


def test_processes_give_the_same(folders, tmp_path):
    sequences, _ = evaluate.find_sequences([str(folders)])
    one = evaluate_folders(sequences, ["lift"], tmp_path / "one")
    two = evaluate_folders(sequences, ["lift"], tmp_path / "two", jobs=2)
    assert one["methods"]["lift"]["psnr"] == pytest.approx(two["methods"]["lift"]["psnr"], abs=1e-4)
    assert two["jobs"] == 2 and list(two["objects"]) == ["a", "b"]


def test_bad_options_are_refused_before_anything_runs(folders, tmp_path, capsys):
    words = ["evaluate", str(folders), "--out", str(tmp_path / "out")]
    for more, says in (
        (["--setup", "sideways"], "sideways: no such setup"),
        (["--size", "12x"], "--size 12x: give numbers"),
        (["--size", "16,32", "--stride", "1,2,3"], "for each of the 2 sizes"),
        (["--methods", "lift+magic:3"], "lift+magic:3: write lift"),
        (["--jobs", "0"], "--jobs 0"),
        (["--seconds", "0"], "--seconds 0"),
    ):
        assert main([*words, *more]) == 2
        assert says in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_the_command_scores_finished_sequences(folders, tmp_path, capsys):
    words = ["evaluate", str(folders), "--setup", "alternating", "--size", "16", "--methods", "white", "--jobs", "1"]
    for f in folders.glob("?/line/transforms.json"):
        f.write_text(re.sub(r'"rig": "(?!target)\w*"', '"rig": "alternating"', f.read_text()))
    assert main([*words, "--out", str(tmp_path / "out")]) == 0
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert list(metrics["objects"]) == ["a", "b"] and metrics["methods"]["white"]["psnr"] > 0
    assert metrics["command"] == shlex.join(["timesplat", *words, "--out", str(tmp_path / "out")])
    assert "LPIPS is left out" in capsys.readouterr().err


def test_tables_say_by_which_command_code_and_weights_they_were_made(folders, tmp_path):
    for f in folders.glob("?/line/transforms.json"):
        f.write_text(re.sub(r'"rig": "(?!target)\w*"', '"rig": "alternating"', f.read_text()))
    out = tmp_path / "my tables"
    words = ["evaluate", str(folders), "--setup", "alternating", "--size", "16", "--methods", "white,guided"]
    words += ["--protocol", "paper", "--samples", "7", "--seed", "3", "--no-lpips", "--stride", "8", "--jobs", "1"]
    assert main([*words, "--out", str(out)]) == 0
    weights = Path(evaluate.CHECKPOINTS / "guided.safetensors").read_bytes()
    for name in ("metrics.md", "metrics.json"):
        text = (out / name).read_text()
        for wanted in ("--protocol paper", "--samples 7", "--seed 3", "--no-lpips", f"'{out}'"):
            assert wanted in text
        assert hashlib.sha256(weights).hexdigest()[:12] in text
    told = json.loads((out / "metrics.json").read_text())["provenance"]
    assert (told["revision"], told["clean"]) == revision(ROOT) and set(told["checkpoints"]) == {"guided.safetensors"}
