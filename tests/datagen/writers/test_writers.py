# SPDX-License-Identifier: GPL-3.0-or-later
"""A Sequence in each layout, read back by our own readers: the same cameras, moments, splits and pictures."""

import numpy as np
import pytest

from timesplat.cli import main
from timesplat.datagen.readers import open_sequence, sequences_in
from timesplat.datagen.readers.lenses import Lens
from timesplat.datagen.sequence import InputError, read_sequence
from timesplat.datagen.writers import LAYOUTS, NAMES, write_layout

from ..readers.worlds import on_white
from .conftest import SQUARE, make

KEEPS_SPLITS = {"dnerf", "nerfstudio", "frames", "sequence", "panoptic"}
KEEPS_CAMERAS = {"nerfstudio", "frames", "sequence", "colmap"}


def paired(seq, again):
    """Of each view the one that was written of it, by moment and place."""
    for i, v in enumerate(seq.views):
        found = [
            k
            for k, w in enumerate(again.views)
            if again.unit_time(w.frame) == pytest.approx(seq.unit_time(v.frame))
            and np.abs(again.normalisation.to_world(w.c2w) - v.c2w).max() < 1e-6
        ]
        assert len(found) == 1, v.image
        yield i, found[0]


@pytest.mark.parametrize("name", NAMES)
def test_the_same_sequence_comes_back(seq, tmp_path, name):
    told = []
    write_layout(seq, tmp_path / "out", name, lambda fraction, text: told.append(fraction))
    again = open_sequence(tmp_path / "out")
    assert told and all(0 <= f <= 1 for f in told) and sequences_in(tmp_path) == [tmp_path / "out"]
    assert (again.width, again.height, len(again.views)) == (seq.width, seq.height, len(seq.views))
    assert again.frame_end - again.frame_start == 2
    for i, k in paired(seq, again):
        v, w = seq.views[i], again.views[k]
        assert (v.fx, v.fy, v.cx, v.cy) == pytest.approx((w.fx, w.fy, w.cx, w.cy))
        if name in KEEPS_SPLITS:
            held = {"canonical": "train", "val": "target" if name == "panoptic" else "val", "target": "target"}
            assert w.rig in (v.rig, held[v.rig])
        if name in KEEPS_CAMERAS:
            assert v.camera == w.camera
        if name == "panoptic":  # over black, with masks of 0 and 1
            assert ((again.load_image(k)[..., 3] > 0) == (seq.load_image(i)[..., 3] > 127)).all()
        else:
            assert (again.load_image(k) == seq.load_image(i)).all()


@pytest.mark.parametrize("name", NAMES)
def test_pictures_that_are_not_square_and_off_centre(tmp_path, name):
    seq = make(tmp_path / "seq", Lens(30, 20, 26.0, 25.0, 16.0, 9.0), moments=2)
    write_layout(seq, tmp_path / "out", name)
    again = open_sequence(tmp_path / "out")
    for i, k in paired(seq, again):
        if name == "dnerf":  # which knows square pictures alone
            w = again.views[k]
            assert again.width == again.height and w.fx == w.fy and (w.cx, w.cy) == (again.width / 2, again.height / 2)
        elif name != "panoptic":
            assert (again.load_image(k) == seq.load_image(i)).all()


@pytest.mark.parametrize("name", sorted({*NAMES} - {"sequence"}))
def test_one_moment_and_nothing_held_out(tmp_path, name):
    seq = make(tmp_path / "seq", SQUARE, held={}, moments=1)
    write_layout(seq, tmp_path / "out", name)
    again = open_sequence(tmp_path / "out")
    assert len(list(paired(seq, again))) == 7 and len(again.views) == 7


def test_whole_or_not_at_all(seq, tmp_path, monkeypatch):
    out = tmp_path / "out"
    for name, layout in LAYOUTS.items():
        write_layout(seq, out / name, name)
        assert (out / name / layout.mark).is_file()
        before = (out / name / layout.mark).stat().st_ino
        write_layout(seq, out / name, name)  # is written over
        assert (out / name / layout.mark).stat().st_ino != before
    with pytest.raises(InputError, match="is not a folder in the layout colmap; it is not overwritten"):
        write_layout(seq, out / "dnerf", "colmap")
    with pytest.raises(InputError, match="--layout x: no such layout; choose sequence, dnerf"):
        write_layout(seq, out / "x", "x")
    broken = read_sequence(seq.folder)
    monkeypatch.setattr(type(broken), "folder", tmp_path / "nowhere")
    with pytest.raises((InputError, OSError)):
        write_layout(broken, out / "broken", "nerfstudio")
    assert sorted(p.name for p in out.iterdir()) == sorted(LAYOUTS)


def test_by_the_command(seq, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["import", str(seq.folder), "--out", str(out), "--layout", "dnerf"]) == 0
    assert f"{out}: 21 pictures" in capsys.readouterr().out and (out / "transforms_train.json").is_file()
    assert on_white(open_sequence(out).load_image(0)).shape == (24, 24, 3)
