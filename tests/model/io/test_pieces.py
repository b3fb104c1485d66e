# SPDX-License-Identifier: GPL-3.0-or-later
"""Pieces against what they stand for: which ones there are, how opaque they are together, and pictures of both."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from timesplat.evaluation.image_quality import psnr
from timesplat.model.gaussians import FIELDS, Gaussians4D
from timesplat.model.io.asset import STATIC_SIGMA_T, Asset, Clip, check
from timesplat.model.io.paths import Paths, continuous, multiply, rotate
from timesplat.model.io.pieces import to_pieces
from timesplat.model.rasterize import render

from ...assets import make_asset, tracked_asset

FRAMES = 24
SIZE = 128


def tube(turn=0.0, bend=0.0, n=2000, opacity=(0.6, 0.99), segments=12) -> Asset:
    """Flat Gaussians on a tube along z, coloured in waves, that turns by `turn` degrees a frame and swings like a tail:
    its end bends by 1.6 times `bend` radians and back in 16 frames. A path for each segment."""
    r = np.random.default_rng(0)
    z, around = r.uniform(-0.8, 0.8, n), r.uniform(0, 2 * np.pi, n)
    path = ((z + 0.8) / 1.6 * segments).astype(int)
    height = (np.arange(segments) + 0.5) / segments * 1.6  # above its foot
    k = np.arange(FRAMES)
    bent, spin = height[:, None] * bend * np.sin(2 * np.pi * k / 16), np.radians(turn) * k + 0 * height[:, None]
    zero = np.zeros_like(bent)
    place = np.stack([bent * height[:, None] / 2, zero, zero + height[:, None] - 0.8], -1)
    tilt = np.stack([np.cos(bent / 2), zero, np.sin(bent / 2), zero], -1)
    rotation = multiply(tilt, np.stack([np.cos(spin / 2), zero, zero, np.sin(spin / 2)], -1))
    f32 = lambda a: np.ascontiguousarray(a, np.float32)  # noqa: E731
    count, ones = np.full(segments, FRAMES, np.int32), np.ones(segments)
    rotation = continuous(f32(rotation.reshape(-1, 4)), count)
    paths = Paths(f32(-ones), f32(ones), count, f32(place.reshape(-1, 3)), rotation)
    t = f32(r.uniform(-1, 1, n))
    at, turned = paths.at(t, path)
    offset = np.stack([0.25 * np.cos(around), 0.25 * np.sin(around), z - (height[path] - 0.8)], 1)
    outward = np.stack([np.cos(around / 2), 0 * z, 0 * z, np.sin(around / 2)], 1)
    waves = 0.5 + 0.4 * np.sin(np.stack([4 * around + 12 * z, 5 * around + 2, 9 * z + around], 1))
    return Asset(
        xyz=f32(at + rotate(turned, f32(offset))),
        t=t,
        velocity=np.zeros((n, 3), np.float32),
        sigma_t=np.full(n, STATIC_SIGMA_T, np.float32),
        scale=f32(0.6 * np.sqrt(2 * np.pi * 0.25 * 1.6 / n) * np.exp(r.normal(0, 0.2, (n, 3))) * [0.2, 1, 1]),
        rotation=f32(multiply(turned, f32(outward))),
        rgb=f32(waves),
        opacity=f32(r.uniform(*opacity, n)),
        clip=Clip(24, 0, FRAMES - 1, pixel=0.01),
        path=path.astype(np.int32),
        paths=paths,
    )


def picture(g: Gaussians4D, time: float, inference: bool) -> torch.Tensor:
    c2w = torch.tensor([[1.0, 0, 0, 0], [0, 0, 1, -3], [0, -1, 0, 0], [0, 0, 0, 1]])[None]
    camera = c2w, torch.tensor([[1.4 * SIZE, 1.4 * SIZE, SIZE / 2, SIZE / 2]]), torch.tensor([time])
    return render(g, *camera, SIZE, SIZE, inference=inference)[0]


def likeness(asset: Asset, pieces: Asset, inference: bool) -> float:
    """PSNR of pictures of the pieces against those of the asset's own moments, at whole frames and between."""
    g, errors = Gaussians4D.from_asset(pieces), []
    for frame in (0, 3, 3.25, 6.5, 9.75, 17.25, 23):
        time = asset.frame_to_time(frame)
        xyz, opacity = asset.at(time)
        seen = opacity > 0
        still = replace(asset, xyz=xyz, rotation=asset.rotation_at(time), opacity=opacity, velocity=0 * xyz)
        truth = Gaussians4D(*(torch.from_numpy(getattr(still, k)[seen]) for k in FIELDS))
        errors.append(10 ** (-psnr(picture(g, time, inference), picture(truth, time, inference)) / 10))
    return float(-10 * torch.log10(torch.stack(errors).mean()))


@pytest.mark.parametrize(
    ("motion", "most", "least"),
    [
        ({}, 1, 99),
        ({"turn": 2}, 16, 48),
        ({"turn": 5, "bend": 0.1}, 26, 46),
        ({"turn": 15}, 26, 41),
        ({"turn": 15, "bend": 0.5}, 26, 35),  # its end goes through an eighth of the object a frame
    ],
)
def test_pictures_are_those_of_the_paths(motion, most, least):
    asset = tube(**motion)
    pieces = to_pieces(asset)
    check(pieces)
    assert pieces.paths is None and len(pieces) <= most * len(asset)
    for inference in (False, True):
        assert likeness(asset, pieces, inference) > least


def test_more_pieces_are_nearer():
    asset = tube(turn=15, bend=0.3)
    once, twice = (likeness(asset, to_pieces(asset, k), False) for k in (1, 2))
    assert twice > once + 3


def test_what_is_there_for_a_while_shows_and_hides_at_its_ends():
    asset = tube(turn=5)
    r = np.random.default_rng(0)
    begins, ends = r.integers(0, 8, 12), r.integers(12, 24, 12)
    start, end = (asset.frame_to_time(f).astype(np.float32) for f in (begins, ends))
    asset = replace(asset, paths=replace(asset.paths, start=start, end=end))
    assert likeness(asset, to_pieces(asset), False) > 43


def together(pieces: Asset, asset: Asset, frame: float, radius: float) -> float:
    """The opacity of all the pieces so many standard deviations of the asset's one Gaussian from its centre."""
    profile = np.exp(-0.5 * (radius * asset.scale[0, 1] / pieces.scale[:, 1]) ** 2)
    return 1 - np.prod(1 - pieces.at(pieces.frame_to_time(frame))[1] * profile)


@pytest.mark.parametrize("opacity", [0.02, 0.3, 0.6, 0.9, 1])
@pytest.mark.parametrize(("begins", "ends"), [(0, 23), (4, 23), (0, 9), (5, 11), (5, 6), (7, 7.5)])
def test_opacities_add_up(opacity, begins, ends):
    """Of one that turns: nearly as they should be, on the average over time still nearer, and nothing a quarter of a
    frame before and after."""
    asset = tube(turn=15, n=1, segments=1)
    asset.opacity[:] = opacity
    start, end = (np.array([asset.frame_to_time(f)], np.float32) for f in (begins, ends))
    pieces = to_pieces(replace(asset, paths=replace(asset.paths, start=start, end=end)))
    inside = np.arange(begins, ends + 0.01, 0.05)
    for radius in (0, 1, 2):
        got = np.array([together(pieces, asset, f, radius) for f in inside])
        want = opacity * np.exp(-0.5 * radius**2)
        np.testing.assert_allclose(got, want, atol=0.24 * opacity)
        assert np.mean(got) == pytest.approx(want, abs=0.11 * opacity)
    for f in (*np.arange(0, begins - 0.24, 0.25), *np.arange(ends + 0.25, 23.1, 0.25)):
        assert together(pieces, asset, f, 0) < 0.04 * opacity


def test_what_needs_no_pieces_is_one_gaussian():
    """It stands still, or goes straight without turning, all through the clip."""
    asset = tracked_asset(30, (1, 2, 2, 3), way=0.2, turn=0)
    asset = replace(asset, paths=replace(asset.paths, start=0 * asset.paths.start - 1, end=0 * asset.paths.end + 1))
    asset.paths.place[-2] = (asset.paths.place[-3] + asset.paths.place[-1]) / 2
    pieces = to_pieces(asset)
    assert len(pieces) == 30 and (pieces.sigma_t == STATIC_SIGMA_T).all()
    for time in (-1, -0.3, 0.9):
        for got, want in zip(pieces.at(time), asset.at(time), strict=True):
            np.testing.assert_allclose(got, want, atol=1e-6)
    np.testing.assert_array_equal(pieces.scale, asset.scale)


def test_an_asset_without_paths_is_itself():
    asset = make_asset()
    assert to_pieces(asset) is asset


def test_pieces_lie_on_their_path():
    """The mean of the pieces that show at a moment, on a circle; a line alone would be off by half of the sagitta."""
    asset = tube(turn=10, n=1, segments=1)
    asset.opacity[:] = 0.01
    pieces = to_pieces(asset)
    for frame in np.arange(0, 23.1, 0.25):
        xyz, opacity = pieces.at(asset.frame_to_time(frame))
        mean = (xyz * opacity[:, None]).sum(0) / opacity.sum()
        assert np.linalg.norm(mean - asset.at(asset.frame_to_time(frame))[0][0]) < 0.0012  # of 0.044 a frame


def test_neighbours_change_over_at_different_times():
    pieces = to_pieces(tube(turn=15, n=16))
    assert len(np.unique(np.round(pieces.t, 4))) > 100


@settings(max_examples=25, deadline=None)
@given(
    st.lists(st.integers(1, 24), min_size=1, max_size=4),
    st.integers(0, 99),
    st.integers(1, 30),
    st.tuples(st.floats(-3, 3, width=32), st.floats(2.0**-10, 2.0**99, width=32)),
)
def test_any_window_gives_pieces(counts, seed, frames, window):
    clip = Clip(24, 0, frames - 1)
    asset = tracked_asset(5, counts, seed, clip=clip)
    start, length = window
    asset.paths.start[0], asset.paths.end[0] = (
        start,
        max(np.float32(start + length), np.nextafter(start, np.float32(9))),
    )
    pieces = to_pieces(asset)
    check(pieces)
    assert len(pieces) <= 5 * (2 * frames + 40)
