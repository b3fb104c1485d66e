# SPDX-License-Identifier: GPL-3.0-or-later
"""docs/datasets.md: what it shows runs, and its contact sheet shows what is there."""

import re
from pathlib import Path

import numpy as np
import pytest

from timesplat.cli import main
from timesplat.datagen.rigs import RIGS
from timesplat.datagen.sequence import read_sequence
from timesplat.evaluation import contact_sheet

PAGE = (Path(__file__).resolve().parents[2] / "docs/datasets.md").read_text()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The page's first command, at a twelfth of its size."""
    where = tmp_path_factory.mktemp("page")
    options = ["--targets", "1", "--size", "8", "--samples", "1", "--frames", "4", "--jobs", "1"]
    assert main(["render", "--zoo", "1000104", "--out", str(where / "data/zoo"), *options]) == 0
    return where


def test_the_snippets_run(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    snippets = re.findall(r"```python\n(.*?)```", PAGE, re.S)
    assert len(snippets) == 2
    scopes = [{}, {}]
    for code, scope in zip(snippets, scopes, strict=True):
        exec(code, scope)
    assert len(capsys.readouterr().out.splitlines()) == 4 * 7
    assert scopes[1]["cameras"].shape == (16, 4, 4) and scopes[1]["passes"].depth.shape == (8, 8)
    ours = scopes[1]["seq"].load_passes(len(scopes[0]["meta"]["frames"]) - 1)
    theirs = scopes[0]["depth"]
    np.testing.assert_array_equal(np.isfinite(ours.depth), theirs < 1e9)
    np.testing.assert_allclose(scopes[0]["flow"], ours.flow_next)


def test_the_rigs_have_as_many_pictures_as_it_says():
    rows = dict(re.findall(r"^\| `(\w+)` \|.*\| (\d+) \|$", PAGE, re.M))
    assert len(rows) == 9
    for rig, count in rows.items():
        assert len(RIGS[rig](range(24), 0)) == int(count)


def test_the_contact_sheet(folder, tmp_path, capsys):
    seq = read_sequence(folder / "data/zoo/zoo-1000104/zoo")
    picture = np.asarray(contact_sheet.contact_sheet(seq, 3))
    rows = 6 + 1 + 2  # six cameras, the target, depth and motion
    assert picture.shape == (20 + rows * (8 + 4), 96 + 3 * (8 + 4), 3)
    first = picture[20:28, 96:104].astype(int)
    image = seq.load_image(0).astype(float)
    over = image[..., :3] * image[..., 3:] / 255 + 255 - image[..., 3:]
    assert np.abs(first - over).max() <= 1
    assert (
        contact_sheet.main([str(folder), str(tmp_path / "x.png")]) == 2 and "transforms.json" in capsys.readouterr().err
    )
    assert not (tmp_path / "x.png").exists()
