# SPDX-License-Identifier: GPL-3.0-or-later
"""`timesplat evaluate`: what metrics.json and tables hold, and what is refused before anything runs."""

import hashlib
import json
import shlex
from pathlib import Path

from timesplat.cli import main
from timesplat.evaluation.provenance import ROOT, revision
from timesplat.evaluation.tables import COLUMNS
from timesplat.model.checkpoints_io import CHECKPOINTS


def test_metrics_json_has_the_promised_names(alternating_folders, tmp_path, capsys):
    words = ["evaluate", str(alternating_folders), "--size", "32", "--methods", "white,lift", "--jobs", "1"]
    assert main([*words, "--out", str(tmp_path / "out")]) == 0
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert set(metrics) >= {"methods", "objects", "machine", "versions"}
    assert list(metrics["methods"]) == ["white", "lift"]
    assert set(metrics["objects"]["a"]["lift"]) == set(metrics["methods"]["lift"]) == set(COLUMNS)
    assert metrics["methods"]["lift"]["psnr"] > metrics["methods"]["white"]["psnr"]
    assert metrics["machine"]["cores"] >= 1 and metrics["versions"]["torch"]
    assert "| lift |" in (tmp_path / "out" / "metrics.md").read_text() and "| lift |" in capsys.readouterr().out


def test_bad_options_are_refused_before_anything_runs(folders, tmp_path, capsys):
    words = ["evaluate", str(folders), "--out", str(tmp_path / "out")]
    for more, says in (
        (["--setup", "sideways"], "sideways: no such setup"),
        (["--size", "12x"], "--size 12x: give numbers"),
        (["--size", "16,32", "--stride", "1,2,3"], "for each of the 2 sizes"),
        (["--methods", "lift+magic:3"], "lift+magic:3: magic:3 is no option"),
        (["--jobs", "0"], "--jobs 0"),
        (["--seconds", "0"], "--seconds 0"),
        (["--device", "tpu7"], "tpu7: torch cannot use this device"),
    ):
        assert main([*words, *more]) == 2
        assert says in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_the_command_scores_finished_sequences(alternating_folders, tmp_path, capsys):
    words = ["evaluate", str(alternating_folders), "--setup", "alternating", "--size", "16"]
    words += ["--methods", "white", "--jobs", "1"]
    assert main([*words, "--out", str(tmp_path / "out")]) == 0
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert list(metrics["objects"]) == ["a", "b"] and metrics["methods"]["white"]["psnr"] > 0
    assert metrics["command"] == shlex.join(["timesplat", *words, "--out", str(tmp_path / "out")])
    assert "LPIPS is left out" in capsys.readouterr().err


def test_tables_say_by_which_command_code_and_weights_they_were_made(alternating_folders, tmp_path):
    out = tmp_path / "my tables"
    words = [
        "evaluate",
        str(alternating_folders),
        "--setup",
        "alternating",
        "--size",
        "16",
        "--methods",
        "white,guided",
    ]
    words += ["--protocol", "paper", "--samples", "7", "--seed", "3", "--no-lpips", "--stride", "8", "--jobs", "1"]
    assert main([*words, "--out", str(out)]) == 0
    weights = Path(CHECKPOINTS / "guided.safetensors").read_bytes()
    for name in ("metrics.md", "metrics.json"):
        text = (out / name).read_text()
        for wanted in ("--protocol paper", "--samples 7", "--seed 3", "--no-lpips", f"'{out}'"):
            assert wanted in text
        assert hashlib.sha256(weights).hexdigest()[:12] in text
    told = json.loads((out / "metrics.json").read_text())["provenance"]
    assert (told["revision"], told["clean"]) == revision(ROOT) and set(told["checkpoints"]) == {"guided.safetensors"}


def test_tables_of_several_setups(alternating_folders, tmp_path):
    out = tmp_path / "out"
    words = ["evaluate", str(alternating_folders), "--size", "16,32", "--stride", "8,4", "--methods", "white,lift"]
    assert main([*words, "--jobs", "1", "--out", str(out)]) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert set(metrics["setups"]) == {"alternating"} and set(metrics["setups"]["alternating"]) == {"16", "32"}
    text = (out / "tables.md").read_text()
    assert text.startswith("`timesplat evaluate") and (out / "tables.csv").read_text().startswith("# timesplat e")
    assert main([*words, "--limit", "0", "--jobs", "1", "--out", str(out)]) == 0  # nothing is left to be made
    assert main([*words[:-1], "hull", "--limit", "0", "--jobs", "1", "--out", str(tmp_path / "late")]) == 2
