# SPDX-License-Identifier: GPL-3.0-or-later
"""The clip of a Sequence: at the frames of its scene where these are known."""

import pytest

from timesplat.datagen.sequence import read_sequence
from timesplat.model.clip import clip_of


@pytest.mark.parametrize(
    ("frames", "clip"),
    [
        (range(1001, 1025), (1001, 1024)),
        (range(-3, 45, 2), (-3, 43)),  # every second frame: it takes as long as in the scene
        ([5, 6, *[7] * 22], (5, 28)),  # a short clip: the scene holds its last frame
        ([9] * 24, (0, 23)),  # one moment, displaced
        ([1, 2, 4, *range(5, 26)], (0, 23)),
        (range(10), (0, 23)),
        ("1001", (0, 23)),
    ],
)
def test_the_clip_is_at_the_frames_of_the_scene(sphere_folder, frames, clip):
    seq = read_sequence(sphere_folder)
    seq.provenance["scene_frames"] = frames if isinstance(frames, str) else list(frames)
    found = clip_of(seq)
    step = frames.step if isinstance(frames, range) else 1
    assert (found.frame_start, found.frame_end, found.fps) == (*clip, seq.fps * step)
    assert found.pixel > 0
