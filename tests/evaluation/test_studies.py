# SPDX-License-Identifier: GPL-3.0-or-later
"""The paper's studies on a scene known by hand."""

import importlib
import json
import os

import numpy as np
import pytest

from timesplat.evaluation import runner, studies


@pytest.fixture
def run(evaluation_folder, tmp_path):
    """run(study, *more) -> exit code; size 16, into tmp_path."""

    def go(study, *more):
        return studies.main([study, str(evaluation_folder.parent), "--out", str(tmp_path), "--size", "16", *more])

    return go


def table_of(path):
    lines = [x.split(" | ") for x in path.read_text().splitlines() if x.startswith("| ")]
    return [[c.strip("| ") for c in row] for row in lines]


def mean(cell):
    return float(cell.split()[0])


def test_scaling_of_inference(run, tmp_path):
    pytest.importorskip("matplotlib")
    assert run("views", "--methods", "white,lift", "--counts", "4,24") == 0
    assert (tmp_path / "views.svg").is_file() and (tmp_path / "views.png").is_file()
    rows = {(r[0], r[1]): mean(r[2]) for r in table_of(tmp_path / "views.md")[1:]}
    assert rows["white", "4"] == rows["white", "24"]
    assert rows["lift", "24"] > rows["lift", "4"] > rows["white", "4"]


def test_an_interrupted_study_goes_on(run, tmp_path, monkeypatch, capsys):
    assert run("video", "--methods", "white") == 0

    def stop(views, method, *rest):
        if method.label == "lift":
            raise KeyboardInterrupt
        pytest.fail("scored again")

    monkeypatch.setattr(runner, "evaluate_views", stop)
    assert run("video", "--methods", "white,lift") == 130
    assert "goes on" in capsys.readouterr().err
    assert run("video", "--methods", "again=white") == 0
    assert len((tmp_path / "rows.jsonl").read_text().splitlines()) == 1


def test_video_scores_what_is_no_input(run, tmp_path):
    assert run("video", "--methods", "white") == 0
    row = json.loads((tmp_path / "rows.jsonl").read_text())
    assert len(row["frames"]["psnr"]) == 5 * 24 - 27
    text = (tmp_path / "video.md").read_text()
    assert "4D-LRM-Free" in text and f"revision {row['revision']}" in text


def test_views_per_frame_has_the_papers_rows(run, tmp_path):
    assert run("views-per-frame", "--methods", "white") == 0
    rows = table_of(tmp_path / "views-per-frame.md")[1:]
    assert len(rows) == 5 * 3
    assert rows[-1][:3] == ["canonical", "4", "paper's 4D-LRM"] and rows[-1][-1] == "30.85 / 0.968"


def test_single_moments_are_reconstructed_still(run, tmp_path, evaluation_folder):
    assert run("static", "--methods", "white,lift", "--every", "12") == 0
    rows = {r[0]: r for r in table_of(tmp_path / "static.md")}
    assert mean(rows["lift"][2]) > mean(rows["white"][2]) + 3
    assert rows["paper: 4D-LRM, GSO"][2] == "27.35"


def test_frames_between_the_inputs_are_scored_apart(run, tmp_path):
    assert run("frame-rate", "--methods", "lift") == 0
    rows = table_of(tmp_path / "frame-rate.md")
    assert [r[1] for r in rows] == ["times", "seen", "between"]
    row = json.loads((tmp_path / "rows.jsonl").read_text())
    seen = np.mean(row["frames"]["psnr"][::4])
    assert mean(rows[1][2]) == pytest.approx(seen, abs=0.006)


def test_lifetimes_and_pictures_are_drawn(run, tmp_path):
    pytest.importorskip("matplotlib")
    assert run("lifetimes", "--methods", "lift") == 0
    assert run("pictures", "--methods", "lift", "--columns", "2", "--setup", "interpolation") == 0
    names = {p.name for p in tmp_path.iterdir()}
    assert {"lifetimes-spheres-lift.svg", "lifetimes-spheres-lift.png"} <= names
    assert {"pictures-spheres-interpolation.svg", "pictures-spheres-interpolation.png"} <= names


def test_training_curves_join_the_stages_of_a_run(tmp_path):
    pytest.importorskip("matplotlib")
    for name in "ab":
        (tmp_path / name).mkdir()
        lines = [{"step": 20 * i, "seconds": i, "cpu_seconds": i, "psnr": 10 + i, "loss": 0.1} for i in (1, 2, 3)]
        (tmp_path / name / "log.jsonl").write_text("\n".join(map(json.dumps, lines)))
    assert studies.main(["training", f"run={tmp_path / 'a'}+{tmp_path / 'b'}", "--out", str(tmp_path)]) == 0
    assert "CPU-seconds" in (tmp_path / "training.svg").read_text() or (tmp_path / "training.png").is_file()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["video", "{data}", "--methods", "magic"], "no such method"),
        (["video", "{data}", "--methods", "lift,lift"], "each once"),
        (["video", "{data}", "--methods", "predicted@nothing"], "no checkpoint nothing"),
        (["video", "{data}", "--size", "20"], "choose --size"),
        (["video", "{data}/nothing"], "no Sequence"),
        (["pictures", "{data}", "--setup", "sideways", "--size", "16"], "no such setup"),
        (["training", "nameless"], "no run in it"),
        (["training", "a={data}"], "no such file"),
    ],
)
def test_bad_input_is_one_sentence(evaluation_folder, tmp_path, capsys, words, message):
    words = [w.format(data=evaluation_folder.parent) for w in words]
    assert studies.main([*words, "--out", str(tmp_path)]) == 2
    err = capsys.readouterr().err
    assert message in err and err.count("\n") == 1 and "Traceback" not in err


def test_missing_views_are_named(sphere_folder, tmp_path, capsys):
    assert studies.main(["static", str(sphere_folder), "--out", str(tmp_path), "--size", "16"]) == 2
    assert "rig evaluation" in capsys.readouterr().err


def test_studies_load_where_affinity_does_not_exist(monkeypatch):
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)  # as on macOS and Windows
    importlib.reload(studies)
