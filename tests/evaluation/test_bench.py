# SPDX-License-Identifier: GPL-3.0-or-later
"""Speed against accuracy: what is run, what is kept, what counts as a frontier, and what is drawn of it."""

import json
import shlex
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from timesplat.cli import main
from timesplat.datagen.sequence import InputError, read_sequence
from timesplat.evaluation import bench, charts, figures, labels
from timesplat.evaluation.bench import AXES, Point, runs_of
from timesplat.evaluation.bench_summary import (
    COLUMNS,
    bench_row,
    frontier,
    read_csv,
    standard_error,
    summarise,
    write_csv,
)
from timesplat.evaluation.cache import Cache
from timesplat.evaluation.method_spec import parse_spec
from timesplat.evaluation.runner import Conditions, run_all

COORDINATES = st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), max_size=12)


@given(COORDINATES)
def test_frontier_is_what_brute_force_says(points):
    cost, worth = [a for a, _ in points], [float(b) for _, b in points]

    def beaten(i: int) -> bool:
        return any(
            c <= cost[i] and w >= worth[i] and ((c, w) != (cost[i], worth[i]) or j < i)
            for j, (c, w) in enumerate(points)
        )

    found = frontier(cost, worth)
    assert sorted(found) == [i for i in range(len(points)) if not beaten(i)]
    assert [cost[i] for i in found] == sorted(cost[i] for i in found)


def test_every_label_of_the_axes_is_a_method_and_is_drawn_as_one():
    assert len(set(AXES.centre)) == len(AXES.centre) and set(AXES.elsewhere) <= set(AXES.centre)
    assert {parse_spec(x).method for x in AXES.centre} <= set(charts.FAMILIES)


# ---------------------------------------------------------------- rows


def rows_of(
    ways=("guided", "guided+refine:1", "guided+budget:10%", "guided+budget:auto", "rgb", "4dgs:1"), objects="abc"
):
    """Made-up rows: a way's quality and cost grow with its place, an object's quality with its name."""
    rows = []
    for setup, size in (("random", 128), ("views-8", 128), ("random", 64)):
        for i, w in enumerate(ways):
            for j, o in enumerate(objects):
                r = dict.fromkeys(COLUMNS, 1.0) | {"object": o, "way": w, "setup": setup, "size": size}
                n = 1000 / (1 + i)
                r |= {"views": 8 if "8" in setup else 24, "seconds": 1.0 + i, "psnr": 20.0 + 2 * j + i + 0.1 * i * j}
                rows.append(
                    r | {"flip": 0.1 / (1 + i), "gaussians": n, "ply_mb": n / 1e4, "usd_mb": None, "lpips": None}
                )
    return rows


def test_lines_join_qualities_and_numbers_of_steps():
    ways = ("tracks:3", "tracks:1", "tracks+quality:fine", "tracks+quality:draft", "tracks+steps:20", "guided")
    ways += ("guided+quality:draft", "guided+quality:draft+budget:9", "guided+budget:9")
    means = [m for m in summarise(rows_of(ways), ("random", 128)) if (m.setup, m.size) == ("random", 128)]
    joined = {k: [m.method.label for m in line] for k, line in charts.lines(means).items()}
    assert joined == {
        "tracks": ["tracks:1", "tracks:3"],
        "tracks+quality": ["tracks+quality:draft", "tracks+quality:fine"],
        "tracks+steps": ["tracks+steps:20"],
        "guided": ["guided"],
        "guided+quality": ["guided+quality:draft"],
        "guided+quality:draft+budget": ["guided+quality:draft+budget:9", "guided+quality:draft"],
        "guided+budget": ["guided+budget:9", "guided"],
    }
    hints = {charts.hint(m) for m in means}
    assert hints == {"3 s", "1 s", "fine", "draft", "20 steps", "", "9"}


FACTS = {
    "date": "2026-01-01",
    "machine": {"cpu": "Abacus", "cores": 2, "system": "Linux"},
    "versions": {"python": "3.11", "torch": "2.13"},
    "jobs": 2,
    "seconds_total": 90.0,
    "centre": ["random", 128],
    "notes": ["A note."],
}


def test_csv_gives_back_what_went_in(tmp_path):
    rows = rows_of()
    write_csv(tmp_path / "bench.csv", rows, "timesplat bench x", FACTS)
    back, command, facts = read_csv(tmp_path / "bench.csv")
    assert (command, facts) == ("timesplat bench x", FACTS)
    for a, b in zip(back, rows, strict=True):
        assert all(a[k] == (pytest.approx(b[k], rel=1e-6) if isinstance(b[k], float) else b[k]) for k in COLUMNS)
    text = (tmp_path / "bench.csv").read_text()
    for damage in (text[: len(text) // 2], "a,b\n1,2\n", text.replace("guided", "magic"), ""):
        (tmp_path / "bad.csv").write_text(damage)
        with pytest.raises(InputError, match=r"bad\.csv: not a whole"):
            read_csv(tmp_path / "bad.csv")
    with pytest.raises(InputError, match="no such file"):
        read_csv(tmp_path / "none.csv")


def test_means_compare_object_by_object():
    means = {m.method.label: m for m in summarise(rows_of(), ("random", 128)) if (m.setup, m.size) == ("random", 128)}
    guided, refined = means["guided"], means["guided+refine:1"]
    assert guided.mean["psnr"] == 22 and guided.gain["psnr"] == 0 == guided.gain_error["psnr"]
    assert guided.error["psnr"] == pytest.approx(2 / 3**0.5)
    gains = [1.0, 1.1, 1.2]
    assert refined.gain["psnr"] == pytest.approx(1.1)
    assert refined.gain_error["psnr"] == pytest.approx(np.std(gains, ddof=1) / 3**0.5) == standard_error(gains)
    assert means["4dgs:1"].gain["psnr"] == pytest.approx(1.1)  # against rgb
    assert guided.mean["usd_mb"] is None
    cut = [r for r in rows_of() if not (r["way"] == "rgb" and r["object"] == "c")]
    assert "rgb" not in {m.method.label for m in summarise(cut, ("random", 128))}


# ---------------------------------------------------------------- pictures


def test_drawing_needs_the_csv_alone(tmp_path, capsys):
    path = tmp_path / "new" / "bench.csv"
    write_csv(path, rows_of(), "timesplat bench x", FACTS)
    assert main(["bench", "--draw", str(path)]) == 0
    assert "4dgs:1" in capsys.readouterr().out
    names = {f.name for f in path.parent.iterdir()}
    assert names == {"bench.csv", "bench.md"} | {
        f"bench-{n}.{kind}" for n in ("seconds", "size", "budgets", "inputs") for kind in ("png", "svg")
    }
    text = (path.parent / "bench.md").read_text()
    assert "Abacus" in text and "A note." in text and "1.5 minutes" in text and "![bench-size](bench-size.png)" in text
    assert "| PSNR / seconds of one thread | RGB alone | rgb, 4dgs:1 | 4dgs:1 |" in text
    assert "timesplat bench x" in (path.parent / "bench-seconds.svg").read_text()
    assert main(["bench", "--draw", str(tmp_path / "none.csv")]) == 2


def test_labels_do_not_cover_each_other():
    rng = np.random.default_rng(0)
    _, (ax,) = figures.panels(1, 5.6, 4.6)
    xs, ys = rng.normal(size=(2, 22)) * 0.3
    ax.plot(xs, ys, "o")
    ax.set(xlim=(-2, 2), ylim=(-2, 2))
    at = list(zip(xs, ys, strict=True))
    words = [(x, y, f"a label {i}", "k") for i, (x, y) in enumerate(at)]
    boxes = labels.place(ax, words, [], [(xs, ys)], at)
    assert len(boxes) == 22
    for i, (low, high) in enumerate(boxes):
        assert not any((low < b).all() and (a < high).all() for a, b in boxes[:i])
    inside = ax.get_window_extent()
    assert all((low >= inside.p0).all() and (high <= inside.p1).all() for low, high in boxes)


def test_budgets_are_drawn_against_no_budget():
    losses = charts.budgets(rows_of(), ("random", 128))
    assert list(losses) == ["guided"] and list(losses["guided"]) == ["a", "b", "c"]
    expected = [(250, 3.0, True), (1000 / 3, 2.0, False), (1000, 0.0, False)]
    assert losses["guided"]["a"] == [pytest.approx(x) for x in expected]


# ---------------------------------------------------------------- running


def test_points_are_what_objects_allow(folders):
    sequences = {n: read_sequence(folders / n / "line") for n in "ab"}
    points, notes = bench.plan(sequences)
    assert {(p.setup, p.size) for p in points} == {("", 32)} and "not random views" in notes[0]
    assert tuple(p.label for p in points)[: len(AXES.centre)] == AXES.centre
    assert all(p.method.fit_seconds <= 3 for p in bench.plan(sequences, quick=True)[0])
    for view in sequences["b"].views:
        view.passes = None
    points, notes = bench.plan(sequences)
    assert not any(p.method.has_depth for p in points) and "b has no depth" in notes[0]
    order = [(r.method.label, r.object) for r in runs_of(sequences, points)]
    slowest = [(x, n) for n in "ab" for x in ("deform:30", "4dgs:30", "som:30", "rgb+refine:30")]
    assert order[-len(slowest) :] == slowest


def test_the_axes_go_through_the_centre(folders, monkeypatch):
    sequences = {n: read_sequence(folders / n / "line") for n in "ab"}
    for seq in sequences.values():
        seq.width = seq.height = 256
    monkeypatch.setattr(bench, "_has", lambda seq, setup: setup != "views-48")
    points, notes = bench.plan(sequences)
    cells = dict.fromkeys((p.setup, p.size) for p in points)
    assert not notes and list(cells) == [("random", 128), ("random", 64), ("random", 256)] + [
        (f"views-{n}", 128) for n in (4, 8, 12)
    ]
    sequences["b"].width = 100
    with pytest.raises(InputError, match="not of one size"):
        bench.plan(sequences)


def test_rows_of_the_runner_are_rows_of_the_csv(folders, tmp_path):
    sequences = {n: read_sequence(folders / n / "line") for n in "ab"}
    runs = runs_of(sequences, [Point(x, "", 32) for x in ("lift", "hull", "gs-lrm-frame")])
    cache = Cache(tmp_path)
    rows = [bench_row(r) for r in run_all(runs, cache, Conditions(costs=True, one_thread=True, started=100.0))]
    assert [(r["way"], r["object"]) for r in rows] == [(r.method.label, r.object) for r in runs]
    lift, gs_lrm = rows[0], rows[2]
    assert lift["ply_mb"] * 1e6 > 50 * lift["gaussians"] and gs_lrm["ply_mb"] is None and lift["coverage"] > 0.5
    assert lift["psnr"] > rows[1]["psnr"] and 0 < lift["flip"] < 1 and lift["views"] == 24
    assert cache.seconds_spent() == max(r["elapsed"] for r in cache.rows().values())


def test_the_command_on_small_objects(folders, tmp_path, capsys):
    out = tmp_path / "out"
    words = ["bench", str(folders), "--methods", "lift,hull,4dgs:0.1", "--jobs", "1", "--out", str(out)]
    assert main(words) == 0
    assert "| frontier |" in capsys.readouterr().out  # who is on it depends on what the machine does
    rows, command, facts = read_csv(out / "bench.csv")
    assert {r["way"] for r in rows} == {"lift", "hull", "4dgs:0.1"}
    assert len(rows) == 6 and command == shlex.join(["timesplat", *words])
    assert facts["centre"] == ["", 32] and facts["seconds_total"] > 0
    assert (out / "bench-seconds.png").is_file() and not (out / "bench-renderer.csv").exists()


def test_bad_options_are_refused_before_anything_runs(folders, tmp_path, capsys):
    words = ["bench", str(folders), "--out", str(tmp_path / "out")]
    for more, says in (
        (["--jobs", "0"], "--jobs 0: give 1"),
        (["--objects", "0"], "--objects 0: give 1"),
        (["--limit", "0"], "--limit 0: give more"),
        (["--size", "100"], "--size 100: give 64"),
        (["--methods", "lift:3"], "take seconds"),
        (["--device", "tpu7"], "tpu7: torch cannot use this device"),
        (["--draw", str(tmp_path / "no.csv")], "no.csv: no such file"),
    ):
        assert main([*words, *more]) == 2
        err = capsys.readouterr().err
        assert says in err and len(err.splitlines()) == 1 and not (tmp_path / "out" / "rows.jsonl").exists()


# ---------------------------------------------------------------- the renderer


def test_more_samples_are_dearer_and_better(tmp_path):
    code = "import json, os\nfrom timesplat.benchmarks.renderer import measure\n"
    code += "rows = measure('zoo:3', 32, (1, 16), 128, (1, 12))\nprint(json.dumps(rows), flush=True)\nos._exit(0)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    few, many = json.loads(done.stdout.splitlines()[-1])
    assert many["psnr"] > few["psnr"] + 5 and few["samples"] == 1 and few["seconds"] > 0
    charts.write_renderer(tmp_path / "bench-renderer.csv", [few, many], "timesplat bench --renderer")
    assert charts.draw_renderer(tmp_path / "bench-renderer.csv") == "bench-renderer"
    assert (tmp_path / "bench-renderer.svg").is_file()
    (tmp_path / "bench-renderer.csv").write_text("# x\n")
    with pytest.raises(InputError, match="not a whole"):
        charts.draw_renderer(tmp_path / "bench-renderer.csv")
