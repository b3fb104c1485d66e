# SPDX-License-Identifier: GPL-3.0-or-later
"""Others' data as a Sequence of ours: nothing is lost, and nothing else is overwritten."""

import numpy as np
import pytest

from timesplat.cli import main
from timesplat.datagen.importing import import_sequence
from timesplat.datagen.readers import open_sequence
from timesplat.datagen.sequence import InputError, read_sequence

from .readers.worlds import shots, write_pictures, write_transforms


@pytest.fixture
def scene(tmp_path):
    taken = shots(12)
    write_pictures(tmp_path / "scene", taken)
    names = [f"images/{k:04d}.png" for k in range(12)]
    half = lambda k, s: {"frame": k + 0.5}  # noqa: E731
    return write_transforms(tmp_path / "scene", taken, frame=half, k1=0.1, test_filenames=names[9:])


def test_everything_comes_back(scene, tmp_path):
    seq = open_sequence(scene)
    told = []
    again = import_sequence(seq, tmp_path / "mine", lambda share, text: told.append(share))
    assert again.picture is None and told == pytest.approx([k / 12 for k in range(12)])
    assert (again.width, again.height, again.fps, again.frame_start, again.frame_end) == (24, 20, 24, 0, 12)
    assert again.normalisation == seq.normalisation and again.aabb == seq.aabb and again.provenance == seq.provenance
    for k, (a, b) in enumerate(zip(seq.views, again.views, strict=True)):
        np.testing.assert_array_equal(a.c2w, b.c2w)
        assert (a.frame, a.camera, a.rig, a.fx, a.fy, a.cx, a.cy) == (b.frame, b.camera, b.rig, b.fx, b.fy, b.cx, b.cy)
        assert (seq.load_image(k) == again.load_image(k)).all()
    assert seq.views[0].image == "images/0000.png" and again.views[0].image == "images/00000.png"


def test_by_the_command(scene, tmp_path, capsys):
    out = tmp_path / "mine"
    assert main(["import", str(scene), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "is undone" in said and f"{out}: 12 pictures" in said and len(read_sequence(out).views) == 12
    (scene / "images/0003.png").unlink()
    assert main(["import", str(scene), "--out", str(tmp_path / "other")]) == 2
    assert "0003.png" in capsys.readouterr().err and not (tmp_path / "other").exists()


def test_nothing_else_is_overwritten(scene, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter").touch()
    with pytest.raises(InputError, match="not overwritten"):
        import_sequence(open_sequence(scene), tmp_path / "mine")
