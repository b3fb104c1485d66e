# SPDX-License-Identifier: GPL-3.0-or-later
"""Frames out of videos: the right ones in any order, and few files open."""

import sys

import numpy as np
import pytest

pytest.importorskip("av", reason="needs timesplat[video]")

from timesplat.datagen.readers import videos
from timesplat.datagen.readers.videos import read_frame, video_of
from timesplat.datagen.sequence import InputError

from .filmed import write_video


@pytest.fixture(scope="module")
def grey(tmp_path_factory):
    """A video whose frame i has the grey 3 i; frames are told from others before and after them."""
    frames = [np.full((32, 48, 3), 3 * i, np.uint8) for i in range(80)]
    path = tmp_path_factory.mktemp("v") / "grey.mp4"
    return write_video(path, frames, 30, codec="libx264", pix_fmt="yuv420p", g=12, bf=3)


@pytest.mark.parametrize("order", [range(80), range(79, -1, -7), (79, 0, 40, 41, 5, 78, 3, 3, 60)])
def test_every_frame_in_any_order(grey, order):
    assert [round(read_frame(grey, i)[..., 0].mean() / 3) for i in order] == list(order)


def test_what_is_told_without_decoding(grey):
    video = video_of(grey)
    assert (video.width, video.height, video.rate, len(video.stamps)) == (48, 32, 30, 80)


def test_colours_and_alpha(tmp_path):
    frames = list(np.random.default_rng(0).integers(0, 256, (3, 20, 24, 3), np.uint8))
    path = write_video(tmp_path / "noise.mp4", frames)
    for i, frame in enumerate(frames):
        got = read_frame(path, i)
        assert got.dtype == np.uint8 and (got[..., :3] == frame).all() and (got[..., 3] == 255).all()


def test_few_files_stay_open(tmp_path):
    paths = [write_video(tmp_path / f"{k}.mp4", [np.full((16, 16, 3), 9 * k, np.uint8)] * 3) for k in range(9)]
    for i in (0, 1, 2):
        assert [read_frame(p, i)[0, 0, 0] for p in paths] == [9 * k for k in range(9)]
        assert len(videos._cursors) <= videos.OPEN


def test_damage_is_named(tmp_path, grey):
    with pytest.raises(InputError, match=r"none\.mp4: the video is missing"):
        video_of(tmp_path / "none.mp4")
    for content in (b"", b"no video" * 99, grey.read_bytes()[:200]):
        path = tmp_path / "bad.mp4"
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"bad\.mp4: the video cannot be read"):
            video_of(path)


def test_without_the_library(monkeypatch, grey):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(InputError, match=r"pip install 'timesplat\[video\]'"):
        read_frame(grey, 0)
