# SPDX-License-Identifier: GPL-3.0-or-later
"""The picture of a folder: which pictures are in it, and that all of it is drawn."""

import numpy as np
import pytest
from PIL import Image

from timesplat.datagen.sequence import read_sequence
from timesplat.evaluation.inspection_picture import SHOWN, shown, thumbnail, write_picture


def test_shown_are_moments_and_cameras_in_turn(sphere_folder):
    seq = read_sequence(sphere_folder)
    chosen = shown(seq)
    frames = [seq.views[i].frame for i in chosen]
    assert frames == list(range(24)) and len(chosen) == SHOWN
    for v in seq.views:
        v.frame = 0
    assert len(shown(seq)) == SHOWN == len(set(shown(seq)))


def test_thumbnails_lie_over_grey(sphere_folder):
    seq = read_sequence(sphere_folder)
    small = thumbnail(seq, 0)
    assert small.shape == (seq.height, seq.width, 3) and small[0, 0] == pytest.approx([0.85] * 3, abs=0.01)


def test_all_of_it_is_drawn(sphere_folder, tmp_path):
    pytest.importorskip("matplotlib")
    seq = read_sequence(sphere_folder)
    write_picture(tmp_path / "a" / "b.png", seq, ["one line", "another"])
    picture = np.asarray(Image.open(tmp_path / "a" / "b.png").convert("RGB")).astype(int)
    blue = (np.abs(picture - (0, 0x72, 0xB2)).max(-1) < 30).sum()
    red = (np.abs(picture - (0xD5, 0x5E, 0)).max(-1) < 30).sum()
    assert blue > 100 and red > 50  # cameras, and those that are held out
    assert [p.name for p in (tmp_path / "a").iterdir()] == ["b.png"]
