# SPDX-License-Identifier: GPL-3.0-or-later
"""A folder of files that do harm goes through the whole of `timesplat render`: nothing is lost, nothing executed, every
file stands in the table, and time is bounded."""

import os
import time

import pytest

from timesplat.datagen.farm import render_assets
from timesplat.datagen.render_child import Limits
from timesplat.datagen.render_index import FAILURES, read_index
from timesplat.datagen.render_job import RenderSettings
from timesplat.datagen.render_pool import cores
from timesplat.datagen.sequence import read_sequence

from . import torture

TINY = RenderSettings(rig="alternating", frames=2, size=16, samples=1, tracks="none")
LIMITS = Limits(seconds=120, memory=3)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return torture.whole_files(tmp_path_factory.mktemp("whole"))


def render(folder, out, limits=LIMITS):
    """{name of the file: its row}; every file of the folder that is an asset has just one."""
    assets = sorted(f for f in folder.iterdir() if f.suffix not in (".png", ".mtl"))
    start = time.monotonic()
    folders, failures = render_assets(
        [str(folder)], out, TINY, jobs=len(cores()), limits=limits, report=lambda sentence: None
    )
    assert time.monotonic() - start < limits.seconds * len(assets) / len(cores()) + 60
    rows = [row for row in read_index(out) if (folder / row.source).exists()]
    assert sorted(row.source for row in rows) == [f.name for f in assets]
    assert {row.sentence for row in rows if row.status != "rendered"} == set(failures)
    for row in rows:
        if row.status == "rendered":
            seq = read_sequence(out / row.sequence)
            assert any(seq.load_image(i)[..., 3].any() for i in range(len(seq.views)))
        else:
            assert row.status in FAILURES and row.sequence == "" and str(folder / row.source) in row.sentence
            assert row.sentence.endswith(".") and "\n" not in row.sentence and ";" in row.sentence
    assert sorted(f.relative_to(out).as_posix() for f in folders) == sorted(r.sequence for r in rows if r.sequence)
    assert not list(out.rglob(".*"))
    return {row.source: row for row in rows}


def test_damaged_files_of_every_kind(whole, tmp_path):
    (tmp_path / "in").mkdir()
    names = torture.build_damaged(tmp_path / "in", whole, each=2, seed=1)
    rows = render(tmp_path / "in", tmp_path / "out")
    assert len(rows) == len(names) == 10
    assert sum(row.status == "refused" for row in rows.values()) >= 3


@pytest.mark.slow  # 300 times Blender: seven minutes on two cores
def test_three_hundred_damaged_files(whole, tmp_path):
    (tmp_path / "in").mkdir()
    names = torture.build_damaged(tmp_path / "in", whole, each=60)
    rows = render(tmp_path / "in", tmp_path / "out")
    assert len(rows) == len(names) == 300
    told = {status: sum(row.status == status for row in rows.values()) for status in ("rendered", *FAILURES)}
    print(told)
    assert told["rendered"] > 20 and told["refused"] > 100


def test_files_that_mean_harm(tmp_path):
    (tmp_path / "in").mkdir()
    canary = tmp_path / "executed"
    expected = torture.build_evil(tmp_path / "in", canary)
    rows = render(tmp_path / "in", tmp_path / "out")
    assert {name: row.status for name, row in rows.items() if expected[name]} == {
        n: s for n, s in expected.items() if s
    }
    assert not canary.exists()
    assert "scripted drivers of Cube did not run" in rows["script.blend"].sentence
    for name in ("texture_30k.glb", "texture_outside.glb", "climbing.obj"):
        assert "light grey" in rows[name].sentence
    assert all("/etc/" not in row.sentence or "outside" in row.sentence for row in rows.values())


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
def test_a_pipe_that_nobody_writes_is_no_file(tmp_path):
    (tmp_path / "in").mkdir()
    os.mkfifo(tmp_path / "in" / "pipe.glb")
    assert render(tmp_path / "in", tmp_path / "out")["pipe.glb"].status == "refused"


def test_one_hangs_and_one_eats_memory(tmp_path):
    (tmp_path / "in").mkdir()
    hangs = torture.build_hanging(tmp_path / "in")
    assert render(tmp_path / "in", tmp_path / "out", Limits(seconds=8))[hangs].status == "time"
    (tmp_path / "in" / hangs).unlink()
    hungry = torture.build_hungry(tmp_path / "in")
    assert render(tmp_path / "in", tmp_path / "out", Limits(seconds=240, memory=1.2))[hungry].status == "memory"
