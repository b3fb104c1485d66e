# SPDX-License-Identifier: GPL-3.0-or-later
"""`timesplat stress` from its command line, on a trial that is rendered."""

import shutil

import pytest

pytest.importorskip("matplotlib")

from timesplat.cli import main
from timesplat.evaluation.stress import command
from timesplat.evaluation.stress.scenes import trial_folder
from timesplat.evaluation.stress.sweeps import SWEEPS

from .conftest import SAMPLES, SIZE


@pytest.fixture
def suite(trial, tmp_path, monkeypatch):
    """A folder whose trial is rendered, at the size and samples that the command takes."""
    (tmp_path / "trials").symlink_to(trial[0] / "trials")
    monkeypatch.setattr(command.StressOptions, "size", SIZE)
    monkeypatch.setattr(command.StressOptions, "samples", SAMPLES)
    return tmp_path


def test_the_whole_road(trial, suite, capsys):
    words = ["stress", "--out", str(suite), "--sweeps", "noisy,shuffled", "--jobs", "1"]
    assert main([*words, "--methods", "white,hull"]) == 0
    said = capsys.readouterr().out
    assert "## noisy: noise (0, 5, 10, 25, 50 σ of 255)" in said and said.strip().endswith("stress.html")
    rows = (suite / "stress.csv").read_text().splitlines()
    assert len(rows) == 1 + 2 * (len(SWEEPS["noisy"].levels) + len(SWEEPS["shuffled"].levels) - 1)
    assert main([*words, "--scenes", str(suite / "scenes")]) == 0
    assert len(list((suite / "scenes").iterdir())) == 9

    # another method, whose pictures are the truth: it goes into the same report
    truth = trial_folder(suite, trial[1], SAMPLES) / "held-out" / "images"
    for condition in (suite / "scenes").iterdir():
        shutil.copytree(truth, suite / "perfect" / condition.name)
    assert main([*words, "--methods", "white", "--score", str(suite / "perfect"), "--name", "theirs"]) == 0
    said = capsys.readouterr().out
    assert "| theirs | 100.00 | never | 100.00 |" in said and "| white |" in said


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--jobs", "0"], "give 1 or more"),
        (["--sweeps", "speeed"], "no such sweep"),
        (["--name", "mine"], "drop it"),
        (["--methods", "magic"], "no such method"),
        (["--score", "nowhere"], "no such folder"),
    ],
)
def test_bad_options_are_a_sentence(tmp_path, capsys, words, said):
    assert main(["stress", "--out", str(tmp_path / "o"), *words]) == 2
    assert said in capsys.readouterr().err and not (tmp_path / "o").exists()
