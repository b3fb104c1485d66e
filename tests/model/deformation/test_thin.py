# SPDX-License-Identifier: GPL-3.0-or-later
"""Out of many tracks the few that a scene needs."""

import pytest
import torch

from timesplat.datagen.sequence import InputError
from timesplat.model.deformation import thin
from timesplat.model.deformation.fit import reconstruct_deform
from timesplat.model.deformation.thin import thinned
from timesplat.model.fitting.fit_views import detached
from timesplat.model.fitting.loop import gradients

from .test_fit import psnr, seen


@pytest.fixture(scope="module")
def fitted():
    return reconstruct_deform(seen(0), steps=200)


def thin_out(tracks, max_loss, progress=None):
    with gradients():
        return thinned(tracks, detached(seen(0)), max_loss, progress)


def test_it_keeps_what_the_scene_needs(fitted):
    told = []
    few = thin_out(fitted, 1.0, lambda fraction, text: told.append(fraction))
    assert thin.FEWEST <= len(few) <= len(fitted) / 2
    assert psnr(few, seen(60)) > psnr(fitted, seen(60)) - 1.5
    assert told == sorted(told) and told[0] >= 0 and told[-1] <= 1


def test_the_less_may_be_lost_the_more_stay(fitted, monkeypatch):
    """With looks as they are: what is lost is known exactly."""
    monkeypatch.setattr(thin, "fit_tracks", lambda tracks, *_, **__: tracks)
    losses = (1e-6, 0.5, 3.0, 100.0)
    kept = [len(thin_out(fitted, loss)) for loss in losses]
    assert kept == sorted(kept, reverse=True) and kept[0] > kept[-1]
    assert thin.FEWEST <= kept[-1] < 2 * thin.FEWEST
    assert all(k in [len(fitted) >> i for i in range(20)] for k in kept)


def test_those_that_show_least_go_first_and_the_rest_stand_for_two(fitted, monkeypatch):
    monkeypatch.setattr(thin, "fit_tracks", lambda tracks, *_, **__: tracks)
    scores = iter((50.0, 50.0, 0.0))  # one halving keeps within the loss, the next does not
    monkeypatch.setattr(thin, "psnr", lambda *_: next(scores))
    monkeypatch.setattr(thin, "contribution", lambda tracks, views: torch.arange(len(tracks)).float())
    half = thin_out(fitted, 0.1)
    count = len(fitted) // 2
    assert torch.equal(half.rgb, fitted.rgb.flip(0)[:count])
    torch.testing.assert_close(half.scale, 2**0.5 * fitted.scale.flip(0)[:count])


def test_nothing_may_be_lost_is_no_loss(fitted):
    with pytest.raises(InputError, match="give more than 0"):
        thin_out(fitted, 0.0)
