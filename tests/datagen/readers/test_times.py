# SPDX-License-Identifier: GPL-3.0-or-later
"""Moments in every way in which they are written."""

import pytest

from timesplat.datagen.readers.times import clip_of, of_names
from timesplat.datagen.sequence import InputError

NONE = [None] * 6


def clip(times=NONE, frames=NONE, fps=None, stated=(None, None)):
    return clip_of([f"{k}.png" for k in range(len(times))], times, frames, fps, stated, "file")


def test_one_clip_in_every_unit():
    unit = [k / 5 for k in range(6)]
    for c in (
        clip(unit),
        clip([100 + k / 24 for k in range(6)]),  # seconds, from anywhere
        clip([k / 24 for k in range(6)], fps=24),  # less than a second of them
        clip(list(map(float, range(6)))),
        clip(frames=list(range(6))),
        clip([100 + k / 24 for k in range(6)], list(range(6))),
        clip(unit, list(range(6)), 24, (0, 5)),
    ):
        assert (c.frames, c.start, c.end, c.fps) == ([0, 1, 2, 3, 4, 5], 0, 5, 24), c
        assert {type(f) for f in c.frames} == {int}
    assert clip([100 + k / 30 for k in range(6)], list(range(6))).fps == 30
    assert clip([7 + k / 29.97 for k in range(6)]).fps == 30
    assert "in seconds" in clip([2.5 + k / 24 for k in range(6)]).told and "0..1" in clip(unit).told


def test_fractions_stay_and_the_range_holds_them_all():
    c = clip([k / 5 for k in range(6)], [k + 0.5 for k in range(6)], 24, (0, 5))
    assert c.frames == [0.5, 1.5, 2.5, 3.5, 4.5, 5.5] and (c.start, c.end) == (0, 6)
    assert clip([0, 0.1, 0.25, 0.5, 0.75, 1]).frames == pytest.approx([0, 0.5, 1.25, 2.5, 3.75, 5])
    assert (clip(frames=[3, 4, 5, 6, 7, 9]).start, clip(frames=[3, 4, 5, 6, 7, 9]).end) == (3, 9)


def test_where_frame_numbers_contradict_the_times_these_hold():
    c = clip([0, 0.2, 0.4, 0.6, 0.8, 1], [0, 0, 0, 0, 0, 1])
    assert c.frames == [0, 1, 2, 3, 4, 5] and "contradict" in c.told


def test_still():
    assert (clip().frames, clip().end) == ([0] * 6, 0) and "stands still" in clip().told
    assert clip_of(["a.png"], [0.5], [None], None, (None, None), "file").end == 1  # one picture may have any time


@pytest.mark.parametrize(
    ("told", "says"),
    [
        ({"times": [0.5] * 6}, "file: all of its times are the same although it has 6 pictures"),
        ({"frames": [3] * 6}, "all of its times are the same"),
        ({"times": [0, 1, None, 1, 0, 1]}, "2.png has no time, others have"),
        ({"frames": [0, 1, 2, float("nan"), 4, 5]}, "the frame of 3.png is not a finite number"),
    ],
)
def test_refused(told, says):
    with pytest.raises(InputError, match=says):
        clip(**told)


def test_names_that_tell():
    rig = [f"images/cam{c}/{6 * t:05d}.jpg" for t in range(3) for c in "ab"]
    assert of_names(rig, None) == ([0, 0, 6, 6, 12, 12], ["cama", "camb"] * 3)
    frames = [f"frame_{t:03d}/c{c}.png" for t in range(3) for c in (1, 2)]
    assert of_names(frames, None) == ([0, 0, 1, 1, 2, 2], ["c1", "c2"] * 3)
    for names in ([f"frame_{k:05d}.jpg" for k in range(4)], [f"{s}/r_{k}.png" for k, s in enumerate("aabb")]):
        assert of_names(names, None) == ([None] * 4, [None] * 4)
    assert of_names(rig, "none") == ([None] * 6, [None] * 6)


def test_names_by_a_pattern():
    names = ["v3_t010.5.png", "v4_t012.png"]
    assert of_names(names, r"_t([\d.]+)\.")[0] == [10.5, 12]
    assert of_names(names, r"(?P<camera>v\d)_t([\d.]+)\.") == ([10.5, 12], ["v3", "v4"])
    assert of_names(["a1.png", "a2.png"], r"(\d)")[1] == ["a*.png"] * 2  # one camera, whose pictures are numbered
    for pattern, says in (
        ("(", "no regular expression"),
        (r"\d", "round brackets"),
        (r"x(\d)", "no number in v3_t010"),
    ):
        with pytest.raises(InputError, match=says):
            of_names(names, pattern)
