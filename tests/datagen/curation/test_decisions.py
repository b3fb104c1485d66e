# SPDX-License-Identifier: GPL-3.0-or-later
from dataclasses import replace

import pytest

from timesplat.datagen.curation.decisions import (
    Bounds,
    Decision,
    decide,
    decided,
    measures_of,
    read_decisions,
    set_of,
    write_decisions,
)
from timesplat.datagen.sequence import InputError

GOOD = Decision(
    *("fox/Run", "", "", ""),
    **{"motion": 0.3, "moves": True, "still": False, "border": 0.0, "empty": 0.0, "size": 0.7, "growth": 1.1},
    **{"variety": 0.2, "magenta": 0.0, "licence": "CC0-1.0", "author": "Ann, Bob", "stamp": "7", "hash": "00ff"},
)


def one(twins=None, bounds=None, **changes):
    (d,) = decide([replace(GOOD, **changes)], bounds or Bounds(), twins or {})
    return d


def test_sets_by_motion():
    assert [set_of(m, False) for m in (0.0, 0.1, 0.25, 0.449, 0.45, float("nan"))] == [
        *("3d", "4d", "hq4d", "hq4d", "4d", "4d")
    ]
    assert set_of(0.3, True) == "3d"
    assert one().set == "hq4d" and one(bounds=Bounds(sufficient=0.4)).set == "4d" and one().reason == ""
    assert one(still=True, moves=False, motion=float("nan")).set == "3d"
    unknown = one(motion=float("nan"))
    assert unknown.set == "4d" and "not known" in unknown.reason


@pytest.mark.parametrize(
    "changes, word",
    [
        ({"empty": 0.5}, "shows nothing"),
        ({"border": 0.1}, "leaves the frame"),
        ({"size": 0.05}, "bounds explode"),
        ({"growth": 4.0}, "bounds explode"),
        ({"magenta": 0.5}, "magenta"),
        ({"variety": 0.001}, "single colour"),
        ({"motion": 0.001}, "still, where motion is promised"),
    ],
)
def test_each_fault_throws_out_and_a_person_can_put_back(changes, word):
    d = one(**changes)
    assert d.set == d.final == "out" and word in d.reason
    assert one(override="4d", **changes).final == "4d" and one(override="4d", **changes).set == "out"
    assert one(override="out").final == "out"


def test_duplicates_are_out():
    assert one(twins={"fox/Run": "cat/Run"}).reason == "duplicate of cat/Run"


def test_the_table_comes_back_and_survives_a_spreadsheet(tmp_path):
    path = tmp_path / "curation.csv"
    rows = [replace(GOOD, sequence="z\udcff"), replace(GOOD, set="out", reason='a "b"; c', motion=float("nan"))]
    write_decisions(path, rows)
    back = read_decisions(path)
    assert [d.sequence for d in back] == ["fox/Run", "z\udcff"] and back[1] == rows[0] and str(back[0]) == str(rows[1])
    assert measures_of(back[1]).motion == 0.3
    saved = path.read_bytes().replace(b"\n", b"\r\n").replace(b"True", b"TRUE").replace(b",,,0.3", b", HQ4D ,,0.3")
    path.write_bytes(b"\xef\xbb\xbf" + saved.replace(b"out,,", b"out,4d,"))
    assert [d.override for d in read_decisions(path)] == ["4d", "hq4d"] and read_decisions(tmp_path / "no.csv") == []


@pytest.mark.parametrize("old, new", [("out,,", "out,keep,"), ("0.3", "much"), (",set,", ",sets,")])
def test_what_is_no_table_is_a_sentence_with_the_line(tmp_path, old, new):
    path = tmp_path / "curation.csv"
    write_decisions(path, [replace(GOOD, set="out")])
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(InputError, match=r"curation\.csv, line 2: .*; write hq4d, 4d, 3d, out or nothing .*\.$"):
        read_decisions(path)


def test_the_nearest_table_decides(tmp_path):
    for folder in ("a/fox/Run", "a/inner/owl/Fly", "b/cat/Sit"):
        (tmp_path / folder).mkdir(parents=True)
    outer = [replace(GOOD, set="hq4d"), replace(GOOD, sequence="inner/owl/Fly", set="out")]
    write_decisions(tmp_path / "a" / "curation.csv", outer)
    inner = [replace(GOOD, sequence="owl/Fly", set="out", override="3d")]
    write_decisions(tmp_path / "a" / "inner" / "curation.csv", inner)
    folders = [tmp_path / f for f in ("a/fox/Run", "a/inner/owl/Fly", "b/cat/Sit")]
    assert decided(folders) == {folders[0]: "hq4d", folders[1]: "3d"}


def test_bounds_in_order():
    with pytest.raises(InputError, match="not in order"):
        Bounds(sufficient=0.5)
