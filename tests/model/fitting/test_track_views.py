# SPDX-License-Identifier: GPL-3.0-or-later
"""The method `tracks`: from views to tracks, within budgets, and through to the asset."""

from dataclasses import replace

import pytest
import torch

from tests.model import track_scenes as scenes
from timesplat.datagen.sequence import InputError
from timesplat.model.fitting.track_views import fewest, reconstruct_tracks
from timesplat.model.gaussians import Gaussians4D
from timesplat.model.io.asset import Clip, check
from timesplat.model.io.ply import read_ply, write_ply
from timesplat.model.methods import ReconstructOptions
from timesplat.model.rasterize import render
from timesplat.model.reconstruct import reconstruct_views
from timesplat.model.tracks import Tracks4D


def test_steps_and_seconds():
    seen, others = scenes.views(), scenes.views(9, seed=5)
    start = reconstruct_tracks(seen, 0.0)
    fitted = reconstruct_tracks(seen, 0.0, steps=30)
    assert scenes.psnr(fitted, others) > scenes.psnr(start, others)
    by_method = reconstruct_views(seen, "tracks", ReconstructOptions(seconds=0.5))
    assert scenes.psnr(by_method, others) > scenes.psnr(start, others)


@pytest.mark.parametrize(("budget", "most"), [("70", 70), ("10%", 60)])
def test_budgets(budget, most):
    few = reconstruct_tracks(scenes.views(), 0.0, steps=10, budget=budget)
    assert 0.5 * most < len(few) <= most


def test_the_fewest_are_as_good_as_twice_as_many(monkeypatch):
    monkeypatch.setattr("timesplat.model.fitting.track_views.TRY_STEPS", 15)
    seen = scenes.views()
    seen.rgb = torch.full_like(seen.rgb, 0.4)  # one colour needs few
    told = []
    found = fewest(scenes.surface(3000), seen, 3.0, progress=lambda fraction, text: told.append(fraction))
    assert found == 500 and told == sorted(told)
    with pytest.raises(InputError, match="more than 0"):
        fewest(seen.surface, seen, 0.0)


def test_without_points_one_sentence():
    with pytest.raises(InputError, match="--tracks auto"):
        reconstruct_tracks(replace(scenes.views(3), surface=None), 1.0)


def test_through_the_file(tmp_path):
    tracks = reconstruct_tracks(scenes.views(), 0.0, steps=20)
    asset = tracks.to_asset(Clip(frame_end=8))
    check(asset)
    write_ply(tmp_path / "a.ply", asset)
    back = Tracks4D.from_asset(read_ply(tmp_path / "a.ply"))
    others = scenes.views(9, seed=5)
    assert scenes.psnr(back, others) == pytest.approx(scenes.psnr(tracks, others), abs=0.02)


def test_straight_pieces_look_the_same():
    """Gaussians4D of an asset on paths: within 0.1 dB of the tracks, at whole and at quarter frames."""
    tracks = reconstruct_tracks(scenes.views(), 0.0, steps=40)
    pieces = Gaussians4D.from_asset(tracks.to_asset(Clip(frame_end=8, pixel=2.7 / scenes.FOCAL)))
    others = scenes.views(9, seed=5)
    for part in (0.0, 0.25):
        between = replace(others, time=(others.time + part * others.frame_step).clamp_max(1.0))
        truth = scenes.views(9, seed=5) if part == 0 else _at(between)
        assert abs(scenes.psnr(pieces, truth) - scenes.psnr(tracks, truth)) < 0.1


def _at(views):

    scene = scenes.ball()
    rgb, alpha = render(scene, views.c2w, views.intrinsics, views.time, scenes.SIZE, scenes.SIZE, background=0.0)
    return replace(views, rgb=rgb / alpha.clamp_min(1e-4)[..., None], alpha=alpha)
