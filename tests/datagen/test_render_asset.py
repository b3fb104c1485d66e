# SPDX-License-Identifier: GPL-3.0-or-later
from types import SimpleNamespace

import pytest

from timesplat.datagen.render_asset import choose_clips, most_moving_clip
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
