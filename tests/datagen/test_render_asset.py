# SPDX-License-Identifier: GPL-3.0-or-later
from types import SimpleNamespace

import pytest

from timesplat.datagen.render_asset import choose_clips, cut_clips, most_moving_clip, scene_frames
from timesplat.datagen.render_job import RenderSettings
from timesplat.datagen.scene.open import open_asset
from timesplat.datagen.sequence import InputError


def test_the_most_moving_clip(two_clips):
    assert most_moving_clip(open_asset(two_clips)).name == "slide"
    alone = SimpleNamespace(name="alone")
    assert most_moving_clip(SimpleNamespace(clips=[alone])) is alone  # without a look at it


def test_the_clips_that_are_asked_for(two_clips):
    asset = open_asset(two_clips)
    chosen = {clip: choose_clips(asset, RenderSettings(clip=clip)) for clip in ("first", "all", "most-moving", "grow")}
    assert chosen["first"] == asset.clips[:1] and chosen["all"] == asset.clips
    assert [c.name for c in chosen["most-moving"]] == ["slide"] and [c.name for c in chosen["grow"]] == ["grow"]


def test_a_clip_that_is_not_there(two_clips):
    with pytest.raises(InputError, match=r"no clip named x; it has .*slide"):
        choose_clips(open_asset(two_clips), RenderSettings(clip="x"))


def test_long_animations_are_cut(two_clips):
    asset = open_asset(two_clips)
    settings = RenderSettings(clip="all", clips="consecutive", frames=8, start=2)
    parts = cut_clips(choose_clips(asset, settings), settings, "x")
    assert {p.name: scene_frames(p, settings) for p in parts} == {
        "slide": [*range(2, 10)],  # frame 10 would be alone
        "grow 01": [*range(2, 10)],
        "grow 02": [*range(10, 18)],
        "grow 03": [*range(18, 26)],
        "grow 04": [26, 27, 28, 29, 30, 30, 30, 30],
    }
    assert parts[-1].actions


def test_a_start_behind_the_end(two_clips):
    asset = open_asset(two_clips)
    settings = RenderSettings(clip="all", start=20)
    assert [c.name for c in cut_clips(asset.clips, settings, "x")] == ["grow"]
    for settings in (RenderSettings(start=31), RenderSettings(start=31, clips="consecutive")):
        with pytest.raises(InputError, match=r"^x: it has 31 frames, none from --start 31 on;.*\.$"):
            cut_clips(asset.clips, settings, "x")


def test_what_moves_most_is_judged_by_the_frames_that_are_rendered(two_clips):
    asset = open_asset(two_clips)
    assert most_moving_clip(asset, RenderSettings(start=12)).name == "grow"  # slide has ended
    assert most_moving_clip(asset, RenderSettings(spread=True)).name == "slide"
