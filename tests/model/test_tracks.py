# SPDX-License-Identifier: GPL-3.0-or-later
"""Tracks4D against their numpy twin, finite differences and the rasteriser."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from timesplat.model.gaussians import Gaussians4D
from timesplat.model.io.asset import Clip, check, rotation_matrices
from timesplat.model.rasterize import render
from timesplat.model.rotations import quaternion_multiply
from timesplat.model.tracks import LOOKS, Paths, Tracks4D


def some_tracks(n: int = 40, dtype=torch.float32) -> Tracks4D:
    """On a path that stands still, a straight one for the first half of the clip, and one of five knots."""
    rng = torch.Generator().manual_seed(0)
    rotation = torch.randn(8, 4, generator=rng) * torch.tensor([0.2, 1, 1, 1]) + torch.tensor([3.0, 0, 0, 0])
    paths = Paths(
        start=torch.tensor([-1.0, -1, -1]),
        end=torch.tensor([1.0, 0, 1]),
        count=torch.tensor([1, 2, 5]),
        place=0.4 * torch.randn(8, 3, generator=rng),
        rotation=torch.nn.functional.normalize(rotation, dim=-1),
    )
    tracks = Tracks4D(
        offset=0.3 * torch.randn(n, 3, generator=rng),
        scale=0.02 + 0.1 * torch.rand(n, 3, generator=rng),
        rotation=torch.nn.functional.normalize(torch.randn(n, 4, generator=rng), dim=-1),
        rgb=torch.rand(n, 3, generator=rng),
        opacity=0.1 + 0.8 * torch.rand(n, generator=rng),
        path=torch.arange(n) % 3,
        paths=paths,
    )
    paths = Paths(*(x if k == "count" else x.to(dtype) for k, x in vars(paths).items()))
    return replace(tracks, **{k: getattr(tracks, k).to(dtype) for k in LOOKS}, paths=paths)


CAMERA = torch.tensor([[[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -2.7], [0, 0, 0, 1]]])


def shoot(scene, times, size=32, **options):
    n = len(times)
    intrinsics = torch.tensor([[35.0, 35, size / 2, size / 2]]).expand(n, 4)
    return render(scene, CAMERA.expand(n, 4, 4), intrinsics, torch.tensor(times), size, size, **options)


@pytest.mark.parametrize("t", [-1.0, -0.37, 0.0, 0.4, 1.0])
def test_like_the_numpy_twin(t):
    tracks = some_tracks()
    clip = Clip(frame_end=8)
    asset = tracks.to_asset(clip)
    check(asset)
    now = tracks.at(t)
    xyz, opacity = asset.at(t)
    assert np.allclose(now.xyz, xyz, atol=1e-5) and np.allclose(now.opacity, opacity, atol=1e-6)
    R = rotation_matrices(asset.rotation_at(t))
    assert np.allclose(now.covariance3(), (R * asset.scale[:, None] ** 2) @ R.transpose(0, 2, 1), atol=1e-5)
    back = Tracks4D.from_asset(asset)
    assert torch.allclose(back.at(t).xyz, now.xyz, atol=1e-5)


def test_there_as_long_as_its_path_is():
    tracks = some_tracks()
    gone = tracks.at(0.01).opacity == 0
    assert torch.equal(gone, tracks.path == 1) and (tracks.at(0.0).opacity > 0).all()


def test_gradients_of_looks_and_knots():
    tracks = some_tracks(6, torch.float64)

    def slice_of(offset, rotation, place, turn):
        paths = replace(tracks.paths, place=place, rotation=turn)
        g = replace(tracks, offset=offset, rotation=rotation, paths=paths).at(0.3)
        return g.xyz, g.covariance3()

    inputs = [tracks.offset, tracks.rotation, tracks.paths.place, tracks.paths.rotation]
    assert torch.autograd.gradcheck(slice_of, [x.clone().requires_grad_() for x in inputs])


@pytest.mark.parametrize("n", [1, 20_000])
def test_compiled_as_by_torch(n):
    """Values and gradients, on one chunk and on several."""
    tracks, rng = some_tracks(n), torch.Generator().manual_seed(1)
    weights = torch.randn(n, 3, generator=rng), torch.randn(n, 4, generator=rng)
    found = []
    for dtype in (torch.float32, torch.float64):  # the latter goes by torch
        leaves = [x.to(dtype).clone().requires_grad_() for x in (tracks.offset, tracks.rotation)]
        paths = Paths(*(x if k == "count" else x.to(dtype) for k, x in vars(tracks.paths).items()))
        g = replace(tracks, offset=leaves[0], rotation=leaves[1], paths=paths).at(0.3)
        ((g.xyz * weights[0]).sum() + (g.rotation * weights[1]).sum()).backward()
        found.append([g.xyz, g.rotation, *(x.grad for x in leaves)])
    for a, b in zip(*found, strict=True):
        assert a.dtype == torch.float32 and torch.allclose(a.double(), b, atol=1e-5)


def test_drawn_as_its_slices_are():
    """Also of several moments at once, side by side."""
    tracks, times = some_tracks(), [-1.0, -0.2, 0.4, 0.4, 1.0]
    rgb, alpha = shoot(tracks, times)
    for i, t in enumerate(times):
        one, opaque = shoot(tracks.at(t), [0.0])
        assert torch.allclose(rgb[i], one[0], atol=1e-5) and torch.allclose(alpha[i], opaque[0], atol=1e-5)


def test_gradients_reach_the_looks_from_several_moments():
    tracks = some_tracks()
    leaves = {k: getattr(tracks, k).clone().requires_grad_() for k in LOOKS}
    shoot(replace(tracks, **leaves), [-0.5, 0.5])[0].square().sum().backward()
    once = {k: v.grad.clone() for k, v in leaves.items()}
    for v in leaves.values():
        v.grad = None
    for t in (-0.5, 0.5):
        shoot(replace(tracks, **leaves), [t])[0].square().sum().backward()
    for k, v in leaves.items():
        assert torch.allclose(v.grad, once[k], atol=1e-4, rtol=1e-3), k


def test_a_straight_gaussian_is_a_track_of_two_knots():
    tracks = some_tracks()
    straight = tracks[tracks.path == 1]
    a, b = straight.at(-1.0), straight.at(0.0)
    turned = quaternion_multiply(tracks.paths.rotation[1:2].expand(len(straight), 4), straight.rotation)
    assert torch.allclose(a.rotation, turned, atol=1e-6)
    middle = straight.at(-0.5)
    assert torch.allclose(middle.xyz.mean(0), 0.5 * (a.xyz + b.xyz).mean(0), atol=0.02)
    assert isinstance(middle, Gaussians4D)


def test_paths_that_nothing_rides_on_are_left_out_of_the_asset():
    tracks = some_tracks()
    asset = tracks[tracks.path == 2].to_asset(Clip())
    assert len(asset.paths) == 1 and len(asset.paths.place) == 5 and len(asset) == 13
