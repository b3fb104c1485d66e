# SPDX-License-Identifier: GPL-3.0-or-later
"""The driver of the training comparisons."""

import json

import pytest

from timesplat.datagen.sequence import InputError
from timesplat.evaluation import ablations
from timesplat.model.checkpoints_io import save_network
from timesplat.model.network import Config, Network


def table_of(path):
    lines = [x.split(" | ") for x in path.read_text().splitlines() if x.startswith("| ")]
    return [[c.strip("| ") for c in row] for row in lines]


@pytest.fixture
def fake_training(monkeypatch):
    """`timesplat train` as a stub that writes what a finished run leaves; returns the commands it got."""
    got = []

    def child(command, environment):
        words = command[command.index("train") + 1 :]
        got.append(words)
        value = {k: words[words.index(k) + 1] for k in ("--out", "--steps", "--head", "--source")}
        from pathlib import Path

        out = Path(value["--out"])
        config = Config(width=32, depth=1, heads=2, head=value["--head"], source=value["--source"])
        save_network(out / "network.safetensors", Network(config), {"steps": value["--steps"]})
        line = {"step": int(value["--steps"]), "seconds": 9, "cpu_seconds": 4.0, "psnr": 15.0}
        (out / "log.jsonl").write_text(json.dumps(line) + "\n")
        (out / "state.pt").write_bytes(b"large")
        return 0

    monkeypatch.setattr(ablations, "run_child", child)
    return got


def test_comparisons_are_trained_once_and_tabulated(sphere_folder, tmp_path, fake_training):
    words = ["--out", str(tmp_path), "--dev", str(sphere_folder), "--steps", "40", "--only", "letter,sweep,low-first"]
    assert ablations.main(words) == 0
    assert len(fake_training) == 4  # low-first has two stages
    first, last = fake_training[2:]
    assert first[first.index("--shrink") + 1] == "4" and first[first.index("--steps") + 1] == "20"
    assert last[last.index("--init") + 1] == str(tmp_path / "low-first" / "first" / "network.safetensors")
    rows = table_of(tmp_path / "comparisons.md")
    assert [r[0] for r in rows] == ["run", "letter", "sweep", "low-first"]
    assert rows[1][2] == "16²" and rows[1][4:7] == ["40", "4", "0.100"] and rows[3][4:6] == ["40", "8"]
    assert not list(tmp_path.rglob("state.pt"))
    assert ablations.main(words) == 0 and len(fake_training) == 4
    assert ablations.main([*words[:-2], "--table"]) == 0


def test_other_options_do_not_continue_a_run(sphere_folder, tmp_path, fake_training, capsys):
    words = ["--out", str(tmp_path), "--dev", str(sphere_folder), "--only", "letter", "--steps"]
    assert ablations.main([*words, "40"]) == 0
    assert ablations.main([*words, "60"]) == 2
    assert "other options" in capsys.readouterr().err


def test_what_training_does_not_know_is_skipped(monkeypatch, sphere_folder, tmp_path, fake_training, capsys):
    runs = [ablations.RUNS[0], ablations.Run("odd", "unheard of", {"--unheard-of": 1})]
    monkeypatch.setattr(ablations, "RUNS", runs)
    assert ablations.main(["--out", str(tmp_path), "--dev", str(sphere_folder), "--steps", "20"]) == 2
    assert "odd: skipped" in capsys.readouterr().err and len(fake_training) == 1
    assert len(table_of(tmp_path / "comparisons.md")) == 2


def test_training_knows_all_the_options():
    options = ablations.AblationOptions(steps=10)
    assert {r.name: ablations.unknown_option(r, options) for r in ablations.RUNS} == {
        r.name: None for r in ablations.RUNS
    }


def test_unknown_runs_are_named(capsys):
    assert ablations.main(["--only", "magic"]) == 2
    assert "no such run" in capsys.readouterr().err


def test_a_damaged_log_is_named(tmp_path):
    (tmp_path / "log.jsonl").write_text("{not json")
    with pytest.raises(InputError, match="damaged"):
        ablations.read_log(tmp_path)
