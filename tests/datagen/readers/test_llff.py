# SPDX-License-Identifier: GPL-3.0-or-later
"""LLFF and Neu3D: poses_bounds.npy with videos, with the frames of each camera, and with photographs."""

import numpy as np
import pytest

pytest.importorskip("av", reason="needs timesplat[video]")

from timesplat.datagen.readers import open_sequence, sequences_in
from timesplat.datagen.readers.lenses import Lens
from timesplat.datagen.readers.llff import read_llff
from timesplat.datagen.readers.options import ReadOptions
from timesplat.datagen.sequence import InputError

from .filmed import film, poses_bounds, rig, write_video
from .worlds import on_white, photograph, save

LENS = Lens(24, 20, 26.0, 26.0, 12.0, 10.0)  # all that the layout can say


@pytest.fixture(scope="module")
def films():
    return rig(8, 5, LENS)


@pytest.fixture
def folder(tmp_path, films):
    film(tmp_path, films, rate=30)
    np.save(tmp_path / "poses_bounds.npy", poses_bounds(films))
    return tmp_path


def same_cameras(seq, films):
    for v in seq.views:
        s = films[int(v.camera.removeprefix("cam"))][0]
        np.testing.assert_allclose(seq.normalisation.to_world(v.c2w), s.c2w, atol=1e-9)
        assert (v.fx, v.fy, v.cx, v.cy) == (26, 26, 12, 10)


def test_one_video_a_camera(folder, films):
    seq = open_sequence(folder)
    same_cameras(seq, films)
    assert seq.provenance["format"] == "Neu3D" and sequences_in(folder) == [folder]
    assert (seq.fps, seq.frame_start, seq.frame_end, len(seq.views)) == (30, 0, 4, 40)
    assert {v.camera for v in seq.views if v.rig == "target"} == {"cam00"} and len(seq.select(rig="train")) == 35
    for i in (0, 7, 39):
        v = seq.views[i]
        truth = on_white(photograph(films[int(v.camera[3:])][v.frame])).astype(int)
        assert np.abs(on_white(seq.load_image(i)).astype(int) - truth).mean() < 4
    assert np.abs(np.mean(seq.aabb, 0)).max() < 0.2  # the balls were found


def test_at_a_rate_the_same_moments_of_all(folder):
    seq = open_sequence(folder, ReadOptions(fps=15))
    assert (seq.fps, seq.frame_end, len(seq.views)) == (15, 2, 24)
    assert {(v.image.split("#")[1], v.frame) for v in seq.views} == {("0", 0), ("2", 1), ("4", 2)}
    assert "15 of 30 frames a second" in seq.provenance["read"]
    with pytest.raises(InputError, match="--fps 60: the videos have 30 frames a second"):
        open_sequence(folder, ReadOptions(fps=60))


def test_videos_of_several_lengths(folder, films):
    write_video(folder / "cam03.mp4", [on_white(photograph(s)) for s in films[3][:3]], 30)
    seq = open_sequence(folder)
    assert (seq.frame_end, len(seq.views)) == (2, 24)
    assert any("the shortest video has 3 frames" in x for x in seq.provenance["read"])


def test_frames_in_a_folder_a_camera(tmp_path, films):
    for shots_of_one in films:
        for n, s in enumerate(shots_of_one):
            save(tmp_path / f"cam{s.camera}/images/{n:04d}.png", photograph(s))
    np.save(tmp_path / "poses_bounds.npy", poses_bounds(films))
    seq = open_sequence(tmp_path)
    same_cameras(seq, films)
    assert (seq.load_image(11) == photograph(films[2][1])).all() and len(seq.select(rig="target")) == 5
    assert open_sequence(tmp_path, ReadOptions(fps=30)).fps == 30


def test_photographs(tmp_path, films):
    for k, (s, *_) in enumerate(films):
        save(tmp_path / f"images/IMG_{k}.png", photograph(s))
    np.save(tmp_path / "poses_bounds.npy", poses_bounds(films))
    seq = open_sequence(tmp_path)
    assert [v.rig for v in seq.views] == ["target", *["train"] * 7] and seq.frame_end == 0
    assert seq.provenance["format"] == "LLFF"


def test_damage_is_named(folder, films):
    path, good = folder / "poses_bounds.npy", poses_bounds(films)
    for rows, says in (
        (good[:-1], "it has 7 cameras, there are 8 videos"),
        (good[:, :9], "it holds 8x9 numbers, not 17 a camera"),
        (np.array([{"a": 1}], object), "it is damaged"),
    ):
        np.save(path, rows, allow_pickle=True)
        with pytest.raises(InputError, match=rf"poses_bounds\.npy: .*{says}"):
            read_llff(folder)
    for p in folder.glob("*.mp4"):
        p.unlink()
    np.save(path, good)
    with pytest.raises(InputError, match="there are 0 pictures in"):
        read_llff(folder)
