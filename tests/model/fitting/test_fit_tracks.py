# SPDX-License-Identifier: GPL-3.0-or-later
"""Tracks fitted to views: better on views that were not fitted, the same on every run, what fades leaves."""

from dataclasses import replace

import torch

from tests.model import track_scenes as scenes
from timesplat.model.fitting.fit_tracks import activate_tracks, fit_tracks, raw_tracks
from timesplat.model.fitting.loop import Schedule
from timesplat.model.geometry.surface_tracks import surface_tracks

STEPS = Schedule(steps=40, pyramid=())


def test_raw_and_back():
    tracks = scenes.ball(50)
    back = activate_tracks(raw_tracks(tracks), tracks)
    for k in ("offset", "scale", "rotation", "rgb", "opacity"):
        assert torch.allclose(getattr(back, k), getattr(tracks, k), atol=1e-5), k


def test_other_views_gain():
    seen, others = scenes.views(), scenes.views(9, seed=5)
    start = surface_tracks(seen.surface, seen)
    fitted = fit_tracks(start, seen, STEPS, pixel=seen.pixel)
    assert scenes.psnr(fitted, others) > scenes.psnr(start, others) + 2
    again = fit_tracks(start, seen, STEPS, pixel=seen.pixel)
    assert torch.equal(fitted.rgb, again.rgb)


def test_what_no_picture_shows_leaves():
    seen = scenes.views()
    start = surface_tracks(seen.surface, seen)
    stray = replace(start[:40], offset=start.offset[:40] * 1.9)  # above the surface, where all views see nothing
    both = {k: torch.cat([getattr(start, k), getattr(stray, k)]) for k in ("offset", "scale", "rotation", "rgb")}
    both |= {k: torch.cat([getattr(start, k), getattr(stray, k)]) for k in ("opacity", "path")}
    fitted = fit_tracks(replace(start, **both), seen, STEPS, pixel=seen.pixel)
    away = (fitted.at(-1.0).xyz - scenes.motion()[0][0]).norm(dim=-1)
    assert int((away > 1.5 * scenes.RADIUS).sum()) < 10
