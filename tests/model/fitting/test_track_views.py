# SPDX-License-Identifier: GPL-3.0-or-later
"""The method `tracks`: from views to tracks, within budgets, and through to the asset."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.model import track_scenes as scenes
from timesplat.datagen.sequence import InputError
from timesplat.datagen.track_file import SurfaceTracks
from timesplat.model.fitting.track_views import fewest, followed, reconstruct_tracks
from timesplat.model.gaussians import Gaussians4D
from timesplat.model.io.asset import Clip, check
from timesplat.model.io.ply import read_ply, write_ply
from timesplat.model.methods import ReconstructOptions
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


def test_without_anything_to_follow_one_sentence():
    with pytest.raises(InputError, match="neither surface tracks nor depth"):
        reconstruct_tracks(replace(scenes.views(3), surface=None, flow=None), 1.0)


def test_motion_vectors_lead_where_the_renderer_followed_nothing_or_not_all():
    """A still moment, so that no motion is the right one. Half of the ball is known, the lower one."""
    seen, others = scenes.views(18), scenes.views(9, seed=5)
    still, truth = scenes.views_at(seen), scenes.views_at(others)
    lone = followed(replace(still, surface=None))
    assert len(lone) > 200
    known = scenes.surface()
    stands = {k: np.repeat(getattr(known, k)[:, 4:5], scenes.FRAMES, 1) for k in ("position", "rotation")}
    lower = known.position[:, 4, 2] < known.position[:, 4, 2].mean()
    half = SurfaceTracks(**{k: a[lower] for k, a in (vars(known) | stands).items()})
    assert len(followed(replace(still, surface=half))) == lower.sum()
    both = followed(replace(still, surface=half, untracked=True))
    assert lower.sum() + 50 < len(both) < lower.sum() + len(lone)
    tracks = reconstruct_tracks(replace(still, surface=half, untracked=True), 0.0, steps=40)
    assert scenes.psnr(tracks, truth) > scenes.psnr(
        reconstruct_tracks(replace(still, surface=half), 0.0, steps=40), truth
    )


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
    return scenes.shoot(views.c2w, views.intrinsics, views.time)
