# SPDX-License-Identifier: GPL-3.0-or-later
import json
import tarfile

import pytest

from timesplat import cli
from timesplat.datagen.readers import open_sequence
from timesplat.datagen.render_index import CRASHED, REFUSED, failure_row, keep_failure, sequence_row, write_index
from timesplat.datagen.render_job import Asset, Part
from timesplat.datagen.shards import PackSettings, bytes_in_shard, pack
from timesplat.evaluation import render_report
from timesplat.evaluation.render_report import Cost, evenly, measure, timed_rows

from ..datagen.writers.conftest import make


@pytest.fixture
def run(tmp_path):
    """Two Sequences that took 6 and 2 seconds, three assets that failed, for two reasons; and the files."""
    for name, spent in (("a/fox", 6.0), ("owl", 2.0)):
        folder = tmp_path / "out" / name / "Run"
        make(folder, moments=2)
        d = json.loads((folder / "transforms.json").read_text())
        d["provenance"] |= {"path": f"{name}.glb", "seconds": 60.0, "cpu_seconds": spent}
        (folder / "transforms.json").write_text(json.dumps(d))
    for name, why, status in (
        ("x", "the file is cut off", REFUSED),
        ("y", "the file is cut off", REFUSED),
        ("z", "Blender died on it (signal 11)", CRASHED),
    ):
        asset = Asset(f"/in/{name}.glb", name, "/in")
        row = failure_row(asset, f"/in/{name}.glb: {why}; do something.", status, cpu_seconds=1.0)
        keep_failure(tmp_path / "out", row, {})
    (tmp_path / "in" / "a").mkdir(parents=True)
    (tmp_path / "in" / "a" / "fox.glb").write_bytes(bytes(3000))
    (tmp_path / "in" / "x.glb").write_bytes(bytes(1000))
    return tmp_path / "out"


def told(capsys, *words):
    code = cli.main(["report", *map(str, words)])
    return code, capsys.readouterr().out


def test_what_was_rendered_and_what_failed(run, tmp_path, capsys):
    code, text = told(capsys, run)
    assert code == 0 and not (run / "index.csv").exists() and "such assets" not in text
    seq = open_sequence(run / "owl" / "Run")
    assert "| assets | 5: 2 rendered, 3 failed |" in text and f"| pictures | {2 * len(seq.views)} |" in text
    assert "| processor seconds, an asset | 2.2 on average, 1.0 for half of them, 5.2 for 95% |" in text  # (6+2+3)/5
    assert f"| pictures a processor second | {2 * len(seq.views) / 11:.2f} |" in text
    assert "| refused | the file is cut off | 2 | x.glb |" in text
    assert "| crashed | Blender died on it (signal 11) | 1 | z.glb |" in text
    assert "The dearest tenth takes 55% of the time; first of all a/fox (6 s), owl (2 s)" in text


def test_what_more_would_take(run, tmp_path, capsys, monkeypatch):
    out = tmp_path / "farm.md"
    code, text = told(capsys, run, "--project", 3_600_000, "--assets", tmp_path / "in", "--mbit", 8, "--out", out)
    assert code == 0 and out.read_text() == text
    assert "| core-hours | 2,200: 1.4 days of 64 cores |" in text
    assert "| download | 7.20 GB, 0.00 MB a file: 2.0 hours at 8 Mbit/s |" in text  # 2,000 bytes each
    assert "takes as long as the rendering on 1,100 cores" in text  # 2.2 seconds to 0.002
    cost = Cost(5, 2.2, 4, 10, {"pictures": 1e6}, {"webp": 5e5, "exr": 1e6}, None)
    monkeypatch.setattr(render_report.shutil, "disk_usage", lambda folder: type("", (), {"free": 10e6}))
    first = " ".join(render_report._first(run, cost, 100, 1000))
    assert "the disk runs out first (the disk after 10 assets" in first and "--shard I/10" in first
    assert "holds them all" in " ".join(render_report._first(run, cost, 9, 1000)) and "download" not in first


def test_sizes_are_those_of_files_and_shards(run, tmp_path):
    rows = render_report._found(run, print)[1]
    cost = measure(run, rows, tmp_path / "in")
    files = [f for name in ("a/fox", "owl") for f in (run / name / "Run").rglob("*") if f.is_file()]
    assert cost.assets == 5 and cost.files == pytest.approx(len(files) / 5) and cost.download == 2000
    assert sum(cost.on_disk.values()) == pytest.approx(sum(f.stat().st_blocks * 512 for f in files) / 5)
    pack(run, tmp_path / "shards", PackSettings())
    with tarfile.open(tmp_path / "shards" / "shard-000000.tar") as tar:
        blocks = {}
        for member in tar:
            kind = member.name.rpartition(".")[2]
            blocks[kind] = blocks.get(kind, 0) + 512 + -(-member.size // 512) * 512
    both = [bytes_in_shard(open_sequence(run / name / "Run"), PackSettings()) for name in ("a/fox", "owl")]
    assert {kind: sum(x[kind] for x in both) for kind in blocks} == pytest.approx(blocks, abs=2048)  # the set is named
    assert sum(cost.packed.values()) == pytest.approx(sum(blocks.values()) / 5, abs=1024)


def test_seconds_by_the_clock_stand_in_where_no_others_are(run, capsys):
    for path in run.rglob("transforms.json"):
        d = json.loads(path.read_text())
        del d["provenance"]["cpu_seconds"]
        path.write_text(json.dumps(d))
    rows = render_report._found(run, print)[1]
    assert [spent for _, spent in timed_rows(rows)] == [1.0, 1.0, 1.0]
    assert "Of 2 assets the processor seconds are not known" in told(capsys, run)[1]
    for path in run.rglob("failed.json"):
        path.unlink()
    code, text = told(capsys, run)
    assert code == 0 and "| seconds by the clock, an asset | 60.0 on average" in text and "stand in for them" in text


def test_tables_of_parts_become_one(run, capsys):
    rows = [sequence_row(run, run / name / "Run") for name in ("a/fox", "owl")]
    write_index(run, rows[:1], Part(1, 2))
    assert told(capsys, run)[0] == 0 and len((run / "index.csv").read_text().splitlines()) == 6


def test_nothing_there_is_one_sentence(tmp_path, capsys):
    for words in ([tmp_path / "no"], [tmp_path], [tmp_path, "--project", 0], [tmp_path, "--mbit", -1]):
        assert cli.main(["report", *map(str, words)]) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1 and ";" in said and said.endswith(".\n")


def test_evenly():
    assert evenly([1, 2], 3) == [1, 2] and evenly(list(range(11)), 3) == [0, 5, 10] and evenly([], 3) == []
