# SPDX-License-Identifier: GPL-3.0-or-later
import csv
import json
from dataclasses import replace

import pyarrow.parquet
import pytest

from timesplat.datagen.licences import Terms
from timesplat.datagen.render_index import (
    REFUSED,
    TIME,
    Row,
    failure_row,
    forget_failure,
    join_index,
    keep_failure,
    kept_failure,
    read_index,
    sequence_row,
    set_terms,
    write_index,
)
from timesplat.datagen.render_job import Asset, Part
from timesplat.datagen.sequence import InputError

FOX = Asset("/x/animals/fox.glb", "animals/fox", "/x")


def make_sequence(folder, **provenance):
    folder.mkdir(parents=True)
    (folder / "transforms.json").write_text(json.dumps({"w": 8, "frames": [{}, {}], "provenance": provenance}))
    return folder


@pytest.fixture
def fox(tmp_path):
    return make_sequence(
        tmp_path / "animals" / "fox" / "Run",
        **{"uid": "fox", "sha256": "ab", "licence": "CC0", "author": "Ann", "clip": "Run", "cameras_seed": 2**32 - 1},
        path="animals/fox.glb",
        **{
            "blender": "5.0.1",
            "timesplat": "0.1.0",
            "seconds": 1.25,
            "cpu_seconds": 3.5,
            "warnings": ["a; b.", 'c, "d"\nü.'],
        },
    )


def test_a_row_says_what_the_sequence_does(fox, tmp_path):
    row = sequence_row(tmp_path, fox, FOX)
    assert row == Row(
        *("animals/fox", "animals/fox/Run", "animals/fox.glb", "fox", "ab", "CC0", "Ann", "Run", 2**32 - 1),
        *("5.0.1", "0.1.0", 2, 1.25, 3.5, "rendered", 'a; b. c, "d"\nü.'),
    )
    (fox / "transforms.json").write_text("{")
    with pytest.raises(InputError, match="damaged"):
        sequence_row(tmp_path, fox, FOX)


def test_both_files_hold_the_same_and_keep_what_others_rendered(fox, tmp_path):
    cut = failure_row(Asset("/x/b\udcff.glb", "b"), "b.glb: it is cut off; export it again.", REFUSED, seconds=0.456)
    write_index(tmp_path, [cut, sequence_row(tmp_path, fox, FOX)])
    rows = read_index(tmp_path)
    assert [r.name for r in rows] == ["animals/fox", "b"] and rows[1] == cut and rows[1].seconds == 0.46
    table = pyarrow.parquet.read_table(tmp_path / "index.parquet")
    assert table.column("sentence").to_pylist() == [r.sentence for r in rows]
    assert table.column("camera_seed").to_pylist() == [2**32 - 1, -1]
    assert str(table.schema.field("camera_seed").type) == "int64" and table.column_names == list(vars(cut))
    with open(tmp_path / "index.csv", newline="", errors="surrogateescape") as f:
        assert next(csv.reader(f)) == table.column_names
    before = [(tmp_path / name).read_bytes() for name in ("index.csv", "index.parquet")]
    write_index(tmp_path, reversed(rows))
    assert before == [(tmp_path / name).read_bytes() for name in ("index.csv", "index.parquet")]
    owl = failure_row(Asset("/x/owl.glb", "owl"), "owl", TIME, terms=Terms("owl", "MIT", "Bo"))
    write_index(tmp_path, [owl])
    assert [r.name for r in read_index(tmp_path)] == ["animals/fox", "b", "owl"]
    (fox / "transforms.json").unlink()
    fox.rmdir()
    write_index(tmp_path, [owl])
    assert [r.name for r in read_index(tmp_path)] == ["b", "owl"] and read_index(tmp_path)[1].licence == "MIT"


def test_a_damaged_table_is_one_sentence(tmp_path):
    (tmp_path / "index.csv").write_text("name,camera_seed\nx,y\n")
    with pytest.raises(InputError, match=r"index\.csv: the table is damaged .*; remove it"):
        read_index(tmp_path)


def test_tables_of_parts_are_joined_and_nothing_is_lost(fox, tmp_path):
    whole = sequence_row(tmp_path, fox, FOX)
    assert sequence_row(tmp_path, fox) == replace(whole, source="animals/fox.glb")
    assert join_index(tmp_path) == [whole] and not (tmp_path / "index.csv").exists()  # it is the run's own to write
    owl = failure_row(Asset("/x/owl.glb", "owl", "/x"), "owl", TIME, sha256="cd", cpu_seconds=2)
    keep_failure(tmp_path, owl, {})
    nowhere = failure_row(Asset("/x/no.glb", "no", "/x"), "no", REFUSED)  # the disk was full
    (tmp_path / "animals" / ".fox.12-ab").mkdir()  # being rendered
    (tmp_path / "animals" / ".fox.12-ab" / "transforms.json").write_text("{")
    write_index(tmp_path, [whole], Part(1, 2))
    fox_once_failed = failure_row(FOX, "fox.glb: no.", TIME)
    write_index(tmp_path, [owl, nowhere, fox_once_failed], Part(2, 2))
    assert read_index(tmp_path) == [] and read_index(tmp_path, Part(1, 2)) == [whole]
    found = []
    rows = join_index(tmp_path, found.append)
    assert rows == read_index(tmp_path) == [whole, nowhere, owl] and found[-1] == 2
    assert pyarrow.parquet.read_table(tmp_path / "index.parquet").num_rows == 3
    before = (tmp_path / "index.parquet").read_bytes()
    assert join_index(tmp_path) == rows and (tmp_path / "index.parquet").read_bytes() == before
    (tmp_path / "owl" / "failed.json").write_text("{")
    with pytest.raises(InputError, match=r"failed\.json: it is missing or damaged; .*\.$"):
        join_index(tmp_path)


def test_a_table_of_an_earlier_version_is_read(tmp_path):
    (tmp_path / "index.csv").write_text("name,sequence,source,seconds,status\nx,x/run,x.glb,2.5,rendered\n")
    assert read_index(tmp_path) == [Row("x", "x/run", "x.glb", seconds=2.5)]


def test_a_failure_stands_for_the_same_file_under_the_same_conditions(tmp_path):
    row = failure_row(FOX, "fox.glb: no.", TIME, sha256="ab", seconds=3)
    assert kept_failure(tmp_path, FOX, "ab", {"limit": 3}) is None
    keep_failure(tmp_path, row, {"limit": 3})
    assert kept_failure(tmp_path, FOX, "ab", {"limit": 3}) == row
    assert kept_failure(tmp_path, FOX, "ab", {"limit": 4}) is None
    assert kept_failure(tmp_path, FOX, "cd", {"limit": 3}) is None
    assert kept_failure(tmp_path, Asset("/x/fox.glb", "animals/fox", "/x"), "ab", {"limit": 3}) is None
    (tmp_path / "animals" / "fox" / "failed.json").write_text("{")
    assert kept_failure(tmp_path, FOX, "ab", {"limit": 3}) is None
    forget_failure(tmp_path, FOX)
    forget_failure(tmp_path, FOX)
    assert list((tmp_path / "animals" / "fox").iterdir()) == []


def test_terms_that_came_later_go_into_the_sequence(fox):
    before = (fox / "transforms.json").read_bytes()
    set_terms(fox, Terms("fox", "CC0", "Ann"))
    assert (fox / "transforms.json").read_bytes() == before
    set_terms(fox, Terms("fox", "MIT", "Bo"))
    d = json.loads((fox / "transforms.json").read_text())
    assert d["w"] == 8 and (d["provenance"]["licence"], d["provenance"]["author"]) == ("MIT", "Bo")
    set_terms(fox, Terms("fox"))  # a run without a table of licences
    assert json.loads((fox / "transforms.json").read_text()) == d
    assert [f.name for f in fox.iterdir()] == ["transforms.json"]
