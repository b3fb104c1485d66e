"""The paper's studies on a scene known by hand, and the driver of the training comparisons."""

import importlib
import json
import math
import os

import numpy as np
import pytest
import torch

from timesplat.datagen import rigs
from timesplat.datagen.sequence import InputError, read_sequence
from timesplat.evaluation import ablations as compare
from timesplat.evaluation import studies, subjects
from timesplat.model.checkpoints_io import save_network
from timesplat.model.network import Config, Network

FRAMES = list(range(24))


@pytest.fixture(scope="module")
def evaluation_folder(spheres, write_views, tmp_path_factory):
    """The spheres from the rig `evaluation` with one held-out view a frame, 32x32."""
    shots = rigs.evaluation(FRAMES) + rigs.targets(FRAMES)
    angles = []
    for s in shots:
        x, y, z = s.c2w[:3, 3] / np.linalg.norm(s.c2w[:3, 3])
        angles.append((math.degrees(math.atan2(-x, -y)), math.degrees(math.asin(z))))
    folder = tmp_path_factory.mktemp("data") / "spheres" / "line"
    write_views(spheres([s.frame for s in shots], angles, size=32), folder)
    path = folder / "transforms.json"
    d = json.loads(path.read_text())
    for f, s in zip(d["frames"], shots, strict=True):
        f["camera"], f["rig"] = s.camera, s.rig
    path.write_text(json.dumps(d))
    return folder


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

    def stop(subject, method, *rest, **how):
        if method.name == "lift":
            raise KeyboardInterrupt
        pytest.fail("scored again")

    monkeypatch.setattr(subjects, "score", stop)
    assert run("video", "--methods", "white,lift") == 130
    assert "goes on" in capsys.readouterr().err
    assert run("video", "--methods", "again=white") == 0
    assert len(json.loads((tmp_path / "scores.json").read_text())) == 1


def test_video_scores_what_is_no_input(run, tmp_path, evaluation_folder):
    assert run("video", "--methods", "white") == 0
    (scores,) = json.loads((tmp_path / "scores.json").read_text()).values()
    assert len(scores["psnr"]) == 5 * 24 - 27
    assert "4D-LRM-Free" in (tmp_path / "video.md").read_text()


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
    subject = subjects.subjects([evaluation_folder], 32)[0]
    views = subjects.collapse(subject.views(subjects.at_frame(subject, 12, "canonical"), subjects.methods("lift")[0]))
    from timesplat.model.geometry.lift import lift

    g = lift(views)
    assert (g.velocity == 0).all() and (g.t == 0).all() and len(g) > 100


def test_frames_between_the_inputs_are_scored_apart(run, tmp_path):
    assert run("frame-rate", "--methods", "lift") == 0
    rows = table_of(tmp_path / "frame-rate.md")
    assert [r[1] for r in rows] == ["times", "seen", "between"]
    (scores,) = json.loads((tmp_path / "scores.json").read_text()).values()
    seen = np.mean(scores["psnr"][::4])
    assert mean(rows[1][2]) == pytest.approx(seen, abs=0.006)


def test_a_thinned_clip_moves_at_the_same_speed(spheres):
    views = spheres([0, 4, 8], size=16)
    thin = subjects.thin(views, 4)
    torch.testing.assert_close(thin.flow / thin.frame_step, views.flow / views.frame_step)
    assert thin.frame_step == pytest.approx(8 / 23)


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
        (["video", "{data}", "--methods", "predicted@nothing"], "no such checkpoint"),
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


def test_a_new_checkpoint_is_scored_anew(tmp_path):
    methods = []
    for n in range(2):
        torch.manual_seed(n)
        path = tmp_path / "net.safetensors"
        save_network(path, Network(Config(width=32, depth=1, heads=2)))
        methods.append(subjects.methods(f"mine=predicted@{path}")[0].stamp)
    assert methods[0] != methods[1]


# ---------------------------------------------------------------- comparisons


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

    monkeypatch.setattr(compare, "run_child", child)
    return got


def test_comparisons_are_trained_once_and_tabulated(sphere_folder, tmp_path, fake_training):
    words = ["--out", str(tmp_path), "--dev", str(sphere_folder), "--steps", "40", "--only", "letter,sweep,low-first"]
    assert compare.main(words) == 0
    assert len(fake_training) == 4  # low-first has two stages
    first, last = fake_training[2:]
    assert first[first.index("--shrink") + 1] == "4" and first[first.index("--steps") + 1] == "20"
    assert last[last.index("--init") + 1] == str(tmp_path / "low-first" / "first" / "network.safetensors")
    rows = table_of(tmp_path / "comparisons.md")
    assert [r[0] for r in rows] == ["run", "letter", "sweep", "low-first"]
    assert rows[1][2] == "16²" and rows[1][4:7] == ["40", "4", "0.100"] and rows[3][4:6] == ["40", "8"]
    assert not list(tmp_path.rglob("state.pt"))
    assert compare.main(words) == 0 and len(fake_training) == 4
    assert compare.main([*words[:-2], "--table"]) == 0


def test_other_options_do_not_continue_a_run(sphere_folder, tmp_path, fake_training, capsys):
    words = ["--out", str(tmp_path), "--dev", str(sphere_folder), "--only", "letter", "--steps"]
    assert compare.main([*words, "40"]) == 0
    assert compare.main([*words, "60"]) == 2
    assert "other options" in capsys.readouterr().err


def test_what_training_does_not_know_is_skipped(monkeypatch, sphere_folder, tmp_path, fake_training, capsys):
    runs = [compare.RUNS[0], compare.Run("odd", "unheard of", {"--unheard-of": 1})]
    monkeypatch.setattr(compare, "RUNS", runs)
    assert compare.main(["--out", str(tmp_path), "--dev", str(sphere_folder), "--steps", "20"]) == 2
    assert "odd: skipped" in capsys.readouterr().err and len(fake_training) == 1
    assert len(table_of(tmp_path / "comparisons.md")) == 2


def test_training_knows_all_the_options():
    args = compare.argparse.Namespace(out=compare.Path("out"), data=compare.Path("data"), steps=10)
    assert {r.name: compare.unknown_option(r, args) for r in compare.RUNS} == {r.name: None for r in compare.RUNS}


def test_unknown_runs_are_named(capsys):
    assert compare.main(["--only", "magic"]) == 2
    assert "no such run" in capsys.readouterr().err


def test_a_damaged_log_is_named(tmp_path):
    (tmp_path / "log.jsonl").write_text("{not json")
    with pytest.raises(InputError, match="damaged"):
        compare.read_log(tmp_path)


def test_chosen_frames_cycle_through_the_canonical_cameras(evaluation_folder):
    seq = read_sequence(evaluation_folder)
    views = [seq.views[i] for i in subjects.every(subjects.Subject("x", seq, 1), 4)]
    assert [v.frame for v in views] == FRAMES[::4]
    assert [v.camera for v in views] == ["front", "left", "back", "right", "front", "left"]


def test_studies_load_where_affinity_does_not_exist(monkeypatch):
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)  # as on macOS and Windows
    importlib.reload(studies)
