# SPDX-License-Identifier: GPL-3.0-or-later
"""What comes and goes in a fit from pictures alone: a blob beside another that is there from the fifth moment on."""

from dataclasses import replace

import torch

from timesplat.model.deformation.appearing import EVER, lives, missing_points, unshown
from timesplat.model.deformation.fit import _Fit, reconstruct_deform
from timesplat.model.gaussians import Gaussians4D
from timesplat.model.rasterize import render
from timesplat.model.views import Views

from .test_fit import FRAMES, SIZE, blobs, psnr, seen

STEP = 2 / (FRAMES - 1)
SINCE = 5  # moment from which on the second blob is there
PLACE = torch.tensor([0.5, 0.0, 0.3])


def coming(offset: float, since: int = SINCE) -> Views:
    """The views of `seen`, in which the second blob stands still, and is there from that moment on."""
    views = seen(offset)
    g = blobs()
    g = replace(g, xyz=torch.stack([g.xyz[0], PLACE]), velocity=torch.zeros(2, 3))
    for i, t in enumerate(views.time.tolist()):
        there = torch.tensor([1.0, float(t > (since - 0.5) * STEP - 1)])
        now: Gaussians4D = replace(g, opacity=g.opacity * there)
        camera = (views.c2w[i : i + 1], views.intrinsics[i : i + 1], views.time[i : i + 1], SIZE, SIZE)
        rgb, alpha = render(now, *camera, background=0.0)
        views.rgb[i], views.alpha[i] = rgb[0] / alpha[0, ..., None].clamp_min(1e-6), alpha[0]
    return views


def test_what_comes_later_is_found_and_is_not_there_before():
    tracks = reconstruct_deform(coming(0), steps=300)
    other = coming(60)
    assert psnr(tracks, other) > 26
    at_second = (tracks.at(1.0).xyz - PLACE).norm(dim=-1) < 0.3
    before, after = (tracks.at(t).opacity[at_second] for t in (-1.0, 1.0))
    assert 1 - (1 - after).prod() > 0.9 and before.max() < 0.1


def test_where_nothing_comes_all_is_as_if_nothing_could(monkeypatch):
    views = coming(0, since=0)
    tracks = reconstruct_deform(views, steps=150)
    monkeypatch.setattr(_Fit, "_join", lambda self: None)
    without = reconstruct_deform(views, steps=150)
    assert len(tracks) == len(without) and torch.equal(tracks.offset, without.offset)
    assert torch.equal(tracks.rgb, without.rgb) and tracks.paths.there(-1.0).all() and tracks.paths.there(1.0).all()


def test_points_are_where_views_about_a_moment_agree_and_live_while_silhouettes_have_them():
    views = coming(0)
    fit = _Fit(views, 400, seed=0)
    fit.parameters["opacity"].detach().fill_(5.0)
    cloud = fit.cloud()
    left, generator = unshown(cloud, views), torch.Generator().manual_seed(0)
    assert not len(missing_points(left, float(views.time[0]), 8, generator)[0])
    t = float(views.time[-1])
    xyz, rgb = missing_points(left, t, 6, generator)
    assert len(xyz) > 50 and ((xyz - PLACE).norm(dim=-1) < 0.4).all() and (rgb[:, 2] > rgb[:, 0]).all()
    inner = xyz[(xyz - PLACE).norm(dim=-1) < 0.07]
    life = lives(cloud, inner, views, t)
    assert len(inner) and torch.allclose(life, torch.tensor([(SINCE - 0.5) * STEP - 1, EVER]).expand_as(life))


def test_tracks_are_there_when_the_cloud_is():
    fit = _Fit(seen(0), 100, seed=0)
    n = len(fit.cloud())
    first = torch.arange(n) % FRAMES
    last = (first + torch.arange(n) // FRAMES % 3).clamp_max(FRAMES - 1)
    life = torch.stack([(first - 0.5) * STEP - 1, (last + 0.5) * STEP - 1], 1)
    life[0] = torch.tensor([(1 + 0.2) * STEP - 1, (1 + 0.8) * STEP - 1])  # at no moment
    life[1] = torch.tensor([-EVER, EVER])
    fit.parameters["life"].detach().copy_(life)
    motion = fit.parameters["motion"].detach()
    motion.copy_(0.05 * torch.randn(motion.shape, generator=torch.Generator().manual_seed(0)))
    cloud = fit.cloud()
    tracks = cloud.to_tracks(FRAMES, 1e-3)
    assert len(tracks) == n - 1
    for t in torch.linspace(-1, 1, FRAMES).tolist():
        told, made = cloud.at(t), tracks.at(t)
        assert torch.equal(told.opacity[1:], made.opacity)
        there = made.opacity > 0
        assert there.any() and (told.xyz[1:] - made.xyz)[there].norm(dim=-1).max() < 2e-3


def test_a_place_at_rest_is_the_one_that_moves_there():
    fit = _Fit(seen(0), 100, seed=0)
    motion = fit.parameters["motion"].detach()
    motion[:, 0] = 0.3  # all of it goes along, and turns
    cloud, xyz = fit.cloud(), torch.tensor([[0.4, 0.1, -0.2], [-0.5, 0.3, 0.0]])
    with torch.no_grad():
        rest = cloud.at_rest(xyz, 0.8)
        assert (rest - xyz).norm(dim=-1).min() > 0.1
        assert (cloud.moved(rest, 0.8)[0] - xyz).norm(dim=-1).max() < 0.01
