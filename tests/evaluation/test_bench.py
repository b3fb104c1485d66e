# SPDX-License-Identifier: GPL-3.0-or-later
"""Speed against accuracy: what is run, what is kept, what counts as a frontier, and what is drawn of it."""

import json
import shlex
import shutil
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from timesplat.cli import main
from timesplat.datagen.sequence import InputError, read_sequence
from timesplat.evaluation import bench, charts, figures, labels
from timesplat.evaluation.bench import Point, parse
from timesplat.evaluation.pareto import frontier, read_csv, standard_error, summarise, write_csv
from timesplat.model.fitting.budget import SECONDS

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


def test_labels():
    way = parse("4dgs:10+budget:10%")
    assert (way.name, way.spec, way.seconds, way.baseline) == ("4dgs", "4dgs+budget:10%", 10, True)
    assert way.fit == 10 + SECONDS
    assert parse("guided+budget:5%").fit == SECONDS and parse("guided+refine:3+budget:5%").fit == 3
    way = parse("guided+refine:3")
    assert way.fit == 3 and way.has_depth and not way.baseline and way.checkpoint is None
    for label, says in (
        ("4dgs", "take seconds"),
        ("lift:3", "take seconds"),
        ("magic", "no such method"),
        ("guided@huge", "no checkpoint guided-huge"),
        ("rgb+magic", "in this order"),
        ("", "write a way"),
    ):
        with pytest.raises(InputError, match=says):
            parse(label)


def test_every_label_of_the_tables_is_a_way_and_is_drawn_as_one():
    assert len(set(bench.CENTRE)) == len(bench.CENTRE) and set(bench.AXES) <= set(bench.CENTRE)
    assert {parse(x).name for x in bench.CENTRE} <= set(charts.FAMILIES)


# ---------------------------------------------------------------- rows


def rows_of(
    ways=("guided", "guided+refine:1", "guided+budget:10%", "guided+budget:auto", "rgb", "4dgs:1"), objects="abc"
):
    """Made-up rows: a way's quality and cost grow with its place, an object's quality with its name."""
    rows = []
    for setup, size in (("random", 128), ("views-8", 128), ("random", 64)):
        for i, w in enumerate(ways):
            for j, o in enumerate(objects):
                r = dict.fromkeys(bench.COLUMNS, 1.0) | {"object": o, "way": w, "setup": setup, "size": size}
                n = 1000 / (1 + i)
                r |= {"views": 8 if "8" in setup else 24, "seconds": 1.0 + i, "psnr": 20.0 + 2 * j + i + 0.1 * i * j}
                rows.append(r | {"flip": 0.1 / (1 + i), "gaussians": n, "ply_mb": n / 1e4, "usd_mb": None})
    return rows


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
        assert all(a[k] == (pytest.approx(b[k], rel=1e-6) if isinstance(b[k], float) else b[k]) for k in bench.COLUMNS)
    text = (tmp_path / "bench.csv").read_text()
    for damage in (text[: len(text) // 2], "a,b\n1,2\n", text.replace("guided", "magic"), ""):
        (tmp_path / "bad.csv").write_text(damage)
        with pytest.raises(InputError, match=r"bad\.csv: not a whole"):
            read_csv(tmp_path / "bad.csv")
    with pytest.raises(InputError, match="no such file"):
        read_csv(tmp_path / "none.csv")


def test_means_compare_object_by_object():
    means = {m.way.label: m for m in summarise(rows_of(), ("random", 128)) if (m.setup, m.size) == ("random", 128)}
    guided, refined = means["guided"], means["guided+refine:1"]
    assert guided.mean["psnr"] == 22 and guided.gain["psnr"] == 0 == guided.gain_error["psnr"]
    assert guided.error["psnr"] == pytest.approx(2 / 3**0.5)
    gains = [1.0, 1.1, 1.2]
    assert refined.gain["psnr"] == pytest.approx(1.1)
    assert refined.gain_error["psnr"] == pytest.approx(np.std(gains, ddof=1) / 3**0.5) == standard_error(gains)
    assert means["4dgs:1"].gain["psnr"] == pytest.approx(1.1)  # against rgb
    assert guided.mean["usd_mb"] is None
    cut = [r for r in rows_of() if not (r["way"] == "rgb" and r["object"] == "c")]
    assert "rgb" not in {m.way.label for m in summarise(cut, ("random", 128))}


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


@pytest.fixture
def folders(sphere_folder, tmp_path):
    """Two objects with one Sequence each."""
    for name in ("a/line", "b/line"):
        copy = shutil.copytree(sphere_folder, tmp_path / "data" / name) / "transforms.json"
        copy.write_text(copy.read_text() + " " * (name[0] == "b"))  # not the same Sequence
    return tmp_path / "data"


def test_points_are_what_objects_allow(folders):
    sequences = {n: read_sequence(folders / n / "line") for n in "ab"}
    points, notes = bench.plan(sequences)
    assert {(p.setup, p.size) for p in points} == {("", 32)} and "not random views" in notes[0]
    assert [p.label for p in points][: len(bench.CENTRE)] == bench.CENTRE
    assert all(parse(p.label).fit <= 3 for p in bench.plan(sequences, quick=True)[0])
    for view in sequences["b"].views:
        view.passes = None
    points, notes = bench.plan(sequences)
    assert not any(parse(p.label).has_depth for p in points) and "b has no depth" in notes[0]
    stages = [[p.label for p in s] for s in bench._stages(points)]
    assert [x for s in stages for x in s if x.endswith("30")] == [x for s in stages[-1:] for x in s]


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


def test_a_run_goes_on_where_it_was(folders, tmp_path, monkeypatch):
    sequences = {n: read_sequence(folders / n / "line") for n in "ab"}
    points = [Point(x, "", 32) for x in ("lift", "hull", "gs-lrm-frame")]
    first = bench.run(sequences, points, tmp_path, started=100.0)
    assert [(r["way"], r["object"]) for r in first] == [(p.label, n) for p in points for n in "ab"]
    assert first[0]["ply_mb"] * 1e6 > 50 * first[0]["gaussians"] and first[4]["ply_mb"] is None
    assert first[0]["psnr"] > first[2]["psnr"] and 0 < first[0]["flip"] < 1 and first[0]["views"] == 24
    lines = (tmp_path / "rows.jsonl").read_text().splitlines()
    assert len(lines) == 6 and bench.spent(tmp_path / "rows.jsonl") == max(json.loads(x)["elapsed"] for x in lines)
    (tmp_path / "rows.jsonl").write_text("\n".join(lines[:-1]) + "\n" + lines[-1][:50])
    made, plain = [], bench.measure
    monkeypatch.setattr(bench, "measure", lambda *a: made.append(a[0]) or plain(*a))
    second = bench.run(sequences, points, tmp_path)
    assert len(made) == 1 and [r["psnr"] for r in second] == [r["psnr"] for r in first]
    assert bench.run(sequences, points, tmp_path / "late", deadline=0) == []


def test_the_command_on_small_objects(folders, tmp_path, capsys):
    out = tmp_path / "out"
    words = ["bench", str(folders), "--methods", "lift,hull,4dgs:0.1", "--jobs", "1", "--out", str(out)]
    assert main(words) == 0
    assert "hull" in capsys.readouterr().out
    rows, command, facts = read_csv(out / "bench.csv")
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
        (["--methods", "lift,4dgs"], "take seconds"),
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
