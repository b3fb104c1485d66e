# SPDX-License-Identifier: GPL-3.0-or-later
import pytest

from timesplat.cli import main
from timesplat.datagen.curation import curate as module
from timesplat.datagen.curation.curate import curate
from timesplat.datagen.curation.decisions import Bounds, read_decisions
from timesplat.datagen.sequence import InputError

from .drawn import box, draw_sequence


@pytest.fixture
def data(tmp_path):
    for name, paint in {
        "a/Run": lambda t, camera: box(0.35 + 0.14 * t),
        "b/Run": lambda t, camera: box(0.35 + 0.14 * t),
        "c/Crawl": lambda t, camera: box(0.4 + 0.05 * t, colour=(30, 160, 60)),
        "d/Stop": lambda t, camera: box(side=0.6),
    }.items():
        draw_sequence(tmp_path / name, paint, licence="CC0-1.0")
    draw_sequence(tmp_path / "e" / "static", lambda t, camera: box(side=0.5, colour=(90, 90, 200)), frames=1)
    return tmp_path


def sets(folder):
    return {d.sequence: d.final for d in read_decisions(folder / "curation.csv")}


def test_sets_and_what_is_thrown_out(data, capsys):
    assert main(["curate", str(data)]) == 0
    assert sets(data) == {"a/Run": "hq4d", "b/Run": "out", "c/Crawl": "4d", "d/Stop": "out", "e/static": "3d"}
    told = capsys.readouterr().out
    assert "1 hq4d, 1 4d, 1 3d, 2 out" in told and "b/Run: duplicate of a/Run" in told
    assert "d/Stop: still, where motion is promised" in told and "curation.html" in told
    assert main(["curate", str(data), "--sufficient", "0.05", "--aggressive", "0.2"]) == 0
    assert sets(data)["c/Crawl"] == "hq4d" and sets(data)["a/Run"] == "4d"
    assert read_decisions(data / "curation.csv")[0].licence == "CC0-1.0"


def test_what_a_person_wrote_stays_and_nothing_is_measured_twice(data, monkeypatch):
    curate(data)
    first = (data / "curation.csv").read_bytes()
    table = first.decode().replace("d/Stop,out,,", "d/Stop,out,3d,").replace("a/Run,hq4d,,", "a/Run,hq4d,out,")
    (data / "curation.csv").write_text(table)
    looked = []
    monkeypatch.setattr(module, "measure", lambda seq, real=module.measure: looked.append(seq.root.name) or real(seq))
    curate(data)
    assert looked == [] and sets(data)["d/Stop"] == "3d" and sets(data)["a/Run"] == "out"
    assert sets(data)["b/Run"] == "hq4d"  # the duplicate of one that is out is the one that is left
    draw_sequence(data / "d" / "Stop", lambda t, camera: box(0.4 + 0.2 * t, side=0.3))
    curate(data)
    assert looked == ["Stop"] and sets(data)["d/Stop"] == "3d"


def test_jobs_change_nothing(data):
    curate(data, jobs=1)
    one = [(data / name).read_bytes() for name in ("curation.csv", "curation.html")]
    (data / "curation.csv").unlink()
    curate(data, jobs=4)
    assert one == [(data / name).read_bytes() for name in ("curation.csv", "curation.html")]


def test_a_damaged_sequence_is_named_and_the_others_go_on(data, capsys):
    next((data / "c" / "Crawl" / "images").iterdir()).write_bytes(b"junk")
    assert main(["curate", str(data)]) == 2
    assert "cannot be read" in capsys.readouterr().out and "c/Crawl" not in sets(data) and len(sets(data)) == 4


def test_nothing_to_curate(tmp_path):
    with pytest.raises(InputError, match="no Sequence in it"):
        curate(tmp_path)
    with pytest.raises(InputError, match="not in order"):
        curate(tmp_path, Bounds(still=0.3))
