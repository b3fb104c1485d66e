# SPDX-License-Identifier: GPL-3.0-or-later
"""Cells: what is written, what is taken from there, and methods that fail."""

from dataclasses import replace

import pytest

from timesplat.datagen.sequence import InputError
from timesplat.evaluation.method_spec import parse_specs
from timesplat.evaluation.stress import cells
from timesplat.evaluation.stress.cells import Cell, Figures, number, run

from .conftest import SAMPLES


def make(trial, methods="white,hull", **how):
    return [Cell(replace(trial[1], **how), m, SAMPLES) for m in parse_specs(methods)]


@pytest.fixture
def folder(trial, tmp_path):
    """A folder of its own with the same trial."""
    (tmp_path / "trials").symlink_to(trial[0] / "trials")
    return tmp_path


def test_rows_are_kept_and_not_made_again(trial, folder, monkeypatch):
    found = run(folder, make(trial), 1)
    white, hull = found.values()
    assert number(hull, "psnr") > number(white, "psnr") and float(white["ghost"]) == 0
    assert all(Figures(folder).picture(key).exists() for key in found)
    monkeypatch.setattr(cells, "row_of", lambda *_: pytest.fail("made again"))
    again = run(folder, make(trial), 1)
    assert {k: float(r["psnr"]) for k, r in again.items()} == {k: r["psnr"] for k, r in found.items()}


def test_a_line_that_was_cut_off_is_made_again(trial, folder):
    run(folder, make(trial), 1)
    path = Figures(folder).path
    path.write_bytes(path.read_bytes()[:-20])
    assert len(Figures(folder).rows()) == 1
    run(folder, make(trial), 1)
    assert len(Figures(folder).rows()) == 2 and path.read_text().count("\n") == 3


def test_seed_and_condition_are_part_of_the_key(trial):
    keys = {c.key for how in ({}, {"seed": 1}, {"disturbance": "noisy", "level": 5.0}) for c in make(trial, **how)}
    assert len(keys) == 6


def test_a_method_that_fails_is_a_row(trial, folder, monkeypatch):
    def fail(views, cell):
        raise InputError("no view shows the object")

    monkeypatch.setattr(cells, "reconstruct", fail)
    (row,) = run(folder, make(trial, "white"), 1).values()
    assert row["failed"] == "InputError: no view shows the object" and number(row, "psnr") != number(row, "psnr")


def test_another_version_is_refused(folder):
    Figures(folder).path.write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match="another version"):
        Figures(folder).rows()
