# SPDX-License-Identifier: GPL-3.0-or-later
"""The fit from pictures alone, of a small scene that moves: two blobs, of which one goes its way."""

import numpy as np
import pytest
import torch

from timesplat.datagen.rigs import spherical
from timesplat.datagen.sequence import opengl_to_opencv
from timesplat.model.deformation.fit import PER_PIXEL, _Fit, pyramid_of, reconstruct_deform, worth
from timesplat.model.fitting.quality import Quality
from timesplat.model.gaussians import Gaussians4D
from timesplat.model.rasterize import render
from timesplat.model.views import Views

from ..geometry.test_surroundings import room

FRAMES, SIZE = 8, 32


def blobs() -> Gaussians4D:
    return Gaussians4D(
        xyz=torch.tensor([[-0.3, 0, 0], [0.3, 0, 0]]),
        t=torch.zeros(2),
        velocity=torch.tensor([[0, 0, 0], [0, 0, 0.4]]),
        sigma_t=torch.full((2,), 1e4),
        scale=torch.full((2, 3), 0.12),
        rotation=torch.tensor([[1.0, 0, 0, 0]]).expand(2, 4),
        rgb=torch.tensor([[0.9, 0.1, 0.1], [0.1, 0.2, 0.9]]),
        opacity=torch.full((2,), 0.98),
    )


def seen(offset: float) -> Views:
    """Three views a frame, from around; `offset` degrees further."""
    poses = [spherical(offset + 137.5 * i, 50 * ((i * 0.618) % 1 - 0.5), 2.7) for i in range(3 * FRAMES)]
    c2w = torch.from_numpy(opengl_to_opencv(np.stack(poses))).float()
    intrinsics = torch.tensor([[SIZE, SIZE, SIZE / 2, SIZE / 2]]).expand(len(poses), 4).float()
    time = torch.linspace(-1, 1, FRAMES).repeat_interleave(3)
    rgb, alpha = render(blobs(), c2w, intrinsics, time, SIZE, SIZE, background=0.0)
    return Views(rgb / alpha[..., None].clamp_min(1e-6), alpha, c2w, intrinsics, time, 2 / (FRAMES - 1))


def psnr(scene, views: Views) -> float:
    rgb, _ = render(scene, views.c2w, views.intrinsics, views.time, SIZE, SIZE)
    return float(-10 * (rgb - views.over(1.0)).square().mean().log10())


def test_it_finds_looks_and_motion():
    tracks = reconstruct_deform(seen(0), steps=300, budget="300")
    assert len(tracks) <= 300
    assert psnr(tracks, seen(60)) > 26
    still = psnr(tracks.at(0.0), seen(60))
    assert psnr(tracks, seen(60)) > still + 3, "it must be the motion that makes it right"


def test_same_seed_same_tracks_and_a_quality_says_how_many():
    few = Quality(size=32, steps=20, gaussians=200)
    a, b, c = (reconstruct_deform(seen(0), quality=few, seed=seed) for seed in (3, 3, 4))
    assert torch.equal(a.offset, b.offset) and torch.equal(a.rgb, b.rgb) and len(a) <= 200
    assert len(a) != len(c) or not torch.equal(a.rgb, c.rgb)


def test_there_are_few_while_pictures_are_small_and_as_many_as_they_are_worth_then():
    views = seen(0)
    most = round(PER_PIXEL[0] * float(views.alpha.sum((1, 2)).mean()))
    assert worth(views) == most and most > 50
    fit = _Fit(views, most, seed=0)
    few = round(most / 4)
    assert [stage.gaussians for stage in fit.stages] == [few, most] and len(fit.cloud()) <= few
    assert len(fit.grown(0.0)) == few and len(fit.grown(0.9)) == most
    assert len(reconstruct_deform(views, steps=400)) > few


def test_a_long_fit_to_many_views_is_given_more():
    views = seen(0)
    many = views[torch.arange(108) % len(views)]
    few, long, longer = (_Fit(many, 10_000, seed=0) for _ in range(3))
    assert not few.planned(4000) and long.planned(6000) and longer.planned(60_000)
    assert long.most == longer.most == worth(many, 6000) == pytest.approx(1.5 * few.most, rel=0.01)
    assert long.stages[-1].gaussians == long.most and few.most == worth(many)
    assert not _Fit(views, 10_000, seed=0).planned(60_000), "a few views are soon learnt by heart"
    half = _Fit(many, 10_000, 0, 0.5)
    assert half.planned(6000) and half.most == pytest.approx(long.most / 2, abs=1)


def test_pictures_double_from_about_128_pixels_to_their_own_size():
    assert [[size for _, size in pyramid_of(n)] for n in (64, 128, 256, 400, 512)] == [
        [32],
        [64],
        [128],
        [100, 200],
        [128, 256],
    ]
    assert [size for _, size in pyramid_of(1024)] == [128, 256, 512] == [size for _, size in pyramid_of(1023)]


def test_motion_goes_on_as_the_views_of_a_further_moment_say(monkeypatch):
    views = seen(0)[list(range(0, 3 * FRAMES, 3))]  # one a moment
    fit = _Fit(views, 50, seed=0)
    moments = fit.table.moments
    values = fit.parameters["motion"].detach()[: len(moments)]
    right = (0.1 * moments.abs())[:, None, None].expand_as(values)  # away from the middle, to both ends
    values[:] = torch.where(moments.abs()[:, None, None] > fit.half, 0.0, right)
    before, last = values.clone(), int((moments <= fit.half).sum()) - 1

    def error(views):
        """As if the views showed what is right after the middle, and before it that nothing goes on."""
        late = bool(views.time[0] > 0)
        return float((values - right)[-4:].abs().sum() if late else (values - before)[:4].abs().sum())

    monkeypatch.setattr(fit, "_error", error)
    fit._carry_on(0.0)
    assert torch.equal(values, before), "it has not come further yet"
    fit._carry_on(fit.fit.window * float(moments[last + 1]) + 1e-4)
    assert torch.allclose(values[last:], right[last:], atol=1e-6)
    assert torch.equal(values[: len(moments) - last], before[: len(moments) - last])


def test_all_of_a_room_is_reconstructed_far_walls_too():
    """The walls are six times as far as the volume reaches, and nothing moves."""
    views = room(SIZE)
    own, other = views[[i for i in range(24) if i % 7]], views[[7, 14]]
    tracks = reconstruct_deform(own, steps=500, budget="1000")
    g = tracks.at(0.0)
    assert (g.xyz.abs().amax(-1) > 3).float().mean() > 0.5 and torch.equal(g.xyz, tracks.at(0.7).xyz)
    assert psnr(tracks, own) > 20 and psnr(tracks, other) > 16


def test_a_budget_of_one():
    assert len(reconstruct_deform(seen(0), steps=2, budget="1")) == 1


def test_auto_is_fewer():
    every, few = (reconstruct_deform(seen(0), steps=200, budget=b, max_loss=1.0) for b in (None, "auto"))
    assert len(few) <= len(every) / 2
