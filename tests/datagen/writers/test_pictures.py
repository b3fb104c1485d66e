# SPDX-License-Identifier: GPL-3.0-or-later
"""Splits, names and square pictures."""

from dataclasses import replace

import numpy as np
from PIL import Image

from timesplat.datagen.readers.lenses import Lens
from timesplat.datagen.sequence import Sequence, View
from timesplat.datagen.writers.pictures import Square, camera_names, frame_names, put, splits_of

from ..readers.worlds import photograph, shots, still
from .conftest import SQUARE, make


def views(*cameras, frames=None, rigs=None):
    eye = np.eye(4)
    return Sequence(8, 8, 24, 0, 9, views=[
        View((frames or range(99))[k], c, (rigs or ["a"] * 99)[k], eye, 9, 9, 4, 4) for k, c in enumerate(cameras)
    ])  # fmt: skip


def test_no_split_is_empty():
    split = lambda *rigs: splits_of(views(*"x" * len(rigs), rigs=rigs))  # noqa: E731
    assert split("a", "val", "target", "a") == {"train": [0, 3], "val": [1], "test": [2]}
    assert split("a", "target") == {"train": [0], "val": [1], "test": [1]}
    assert split("a", "val") == {"train": [0], "val": [1], "test": [1]}
    assert split(*"a" * 9) == {"train": list(range(9)), "val": [0, 8], "test": [0, 8]}
    assert split("target") == {"train": [0], "val": [0], "test": [0]}


def test_names():
    assert list(frame_names(views(*"aab", frames=[3, 12, 12])).values()) == ["0003", "0012"]
    assert list(frame_names(views(*"ab", frames=[0.5, 2])).values()) == ["0000.500", "0002.000"]
    assert list(frame_names(views(*"abc", frames=[-3, 0, 1])).values()) == ["0000", "0003", "0004"]
    names = camera_names(views("a/b", "a b", "ä", "A-B", "x", frames=[0, 0, 0, 0, 1]))
    assert names == ["a-b", "a-b-2", "camera", "A-B-3", "x"]


def test_square_pictures_are_copied_as_they_are(seq, tmp_path):
    square = Square.around(seq)
    assert square == Square(24, 26.0)
    square.put(seq, 5, tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes() == (seq.folder / seq.views[5].image).read_bytes()
    put(replace(seq, picture=lambda v: np.full((24, 24, 4), 9, np.uint8)), 5, tmp_path / "b.png")
    assert (np.asarray(Image.open(tmp_path / "b.png")) == 9).all()


def test_others_are_as_a_square_camera_takes_them(tmp_path):
    seq = make(tmp_path / "seq", Lens(60, 40, 52.0, 50.0, 32.0, 18.0), moments=1, held={})
    square = Square.around(seq)
    assert square.focal == 51 and square.side == 2 * np.ceil(51 * 32 / 52)
    lens = Lens(square.side, square.side, 51.0, 51.0, square.side / 2, square.side / 2)
    for k, s in enumerate(shots(7, lens=lens)):
        square.put(seq, k, tmp_path / "x.png")
        got, truth = np.asarray(Image.open(tmp_path / "x.png")), photograph(still(s))
        inner = slice(square.side // 2 - 17, square.side // 2 + 17)  # which the view shows in full
        assert np.abs(got[inner, inner, 3].astype(int) - truth[inner, inner, 3]).mean() < 6
        assert (got[0, :, 3] == 0).all()  # above the view nothing is


def test_several_focal_lengths(tmp_path):
    seq = make(tmp_path / "seq", SQUARE, moments=1)
    seq.views[0] = replace(seq.views[0], fx=20.0, fy=20.0)
    assert Square.around(seq) == Square(32, 26.0)
