# SPDX-License-Identifier: GPL-3.0-or-later
"""How many samples USD gets of an asset, and that they are right."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from timesplat.datagen.sequence import InputError
from timesplat.model.io.asset import Asset, Clip, rotation_matrices
from timesplat.model.io.usd_samples import extent_of, orientations, positions

from ...assets import make_asset, tracked_asset

A = Path("a.usdc")


def always(asset: Asset) -> Asset:
    """The same with paths that are there all through the clip."""
    return replace(asset, paths=replace(asset.paths, start=0 * asset.paths.start - 1, end=0 * asset.paths.end + 1))


@pytest.mark.parametrize(
    ("asset", "places", "turns"),
    [
        (make_asset(9), 2, 1),
        (make_asset(9, speed=0), 1, 1),
        (tracked_asset(9), 24, 24),
        (tracked_asset(9, (1, 1)), 1, 1),
        (tracked_asset(9, (1, 2, 2), turn=0), 24, 1),  # some stop within the clip
        (always(tracked_asset(9, (1, 2, 2), turn=0)), 2, 1),
        (always(tracked_asset(9, (1, 2))), 24, 24),
        (tracked_asset(9, clip=Clip(24, 5, 5)), 1, 1),
    ],
)
def test_as_few_samples_as_say_it(asset, places, turns):
    first, last = asset.clip.frame_start, asset.clip.frame_end
    whole = [code for code in positions(asset, False, A) if code % 1 == 0]
    assert whole[:: max(places - 1, 1)] == sorted({first, last})[:places]
    assert len(whole) == places and len(orientations(asset)) == turns
    assert len(positions(asset, True, A)) == (24 if places > 1 else 1)


def test_samples_are_the_asset_at_its_frames():
    asset = tracked_asset(40, turn=0.6)
    at = positions(asset, False, A)
    turned = orientations(asset, at)
    assert list(at) == list(turned) and {*at} >= {*asset.clip.frames}
    for frame, xyz in at.items():
        time = asset.frame_to_time(frame)
        np.testing.assert_array_equal(xyz, asset.at(time)[0])
        np.testing.assert_allclose(
            rotation_matrices(turned[frame]), rotation_matrices(asset.rotation_at(time)), atol=1e-6
        )
    for a, b in zip(asset.clip.frames, asset.clip.frames[1:], strict=False):
        assert ((turned[a] * turned[b]).sum(1) > 0).all()


def spun(degrees: float, size: float) -> Asset:
    """Gaussians on a disc of radius 0.5 that turns by so many degrees a frame about where it stands."""
    asset = always(tracked_asset(30, (24,), way=0, clip=Clip(24, 1, 24)))
    angle = np.radians(degrees) * np.arange(24)
    asset.paths.place[:] = 0
    asset.paths.rotation[:] = np.stack([np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)], 1)
    round_ = np.linspace(0, 2 * np.pi, 30)
    asset.xyz[:] = 0.5 * np.stack([np.cos(round_), np.sin(round_), 0 * round_], 1)
    asset.t[:], asset.scale[:], asset.opacity[:] = -1, size, 1
    return replace(asset, clip=replace(asset.clip, pixel=0.0))


@pytest.mark.parametrize(("degrees", "size", "parts"), [(5, 0.02, 1), (60, 0.05, 2), (60, 0.02, 4), (60, 0.5, 1)])
def test_what_bends_between_frames_is_sampled_there(degrees, size, parts):
    """Off a chord is 0.5 (1 - cos(degrees / 2)), for halves and quarters of it a fourth and a sixteenth of that."""
    asset = spun(degrees, size)
    samples = positions(asset, False, A)
    assert list(samples) == [1 + i / parts for i in range(23 * parts + 1)]
    assert list(orientations(asset, samples)) == list(samples)
    assert list(positions(asset, True, A)) == list(range(1, 25)), "readers that hold samples get whole frames"
    for code in np.arange(1, 24, 1 / 8):
        line = np.array(
            [np.interp(code, list(samples), column) for column in np.stack(list(samples.values()), -1)[:, 0]]
        )
        away = np.abs(line - asset.at(asset.frame_to_time(code))[0][:, 0])
        assert away.max() < size, "wherever one looks"


def test_only_those_frames_have_more_in_which_it_bends():
    asset = spun(0, 0.02)
    angle = np.radians(60) * np.clip(np.arange(24) - 10, 0, 2)
    asset.paths.rotation[:] = np.stack([np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)], 1)
    between = [code for code in positions(asset, False, A) if code % 1]
    assert between == [11.25, 11.5, 11.75, 12.25, 12.5, 12.75]


def test_the_extent_is_of_what_turns_as_it_is_turned():
    """A needle that turns by a right angle: along x at first, along y at the end."""
    asset = always(tracked_asset(1, (7,), way=0))
    asset.paths.place[:] = asset.xyz[:] = 0
    angle = np.linspace(0, np.pi / 2, 7)
    asset.paths.rotation[:] = np.stack([np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)], 1)
    asset.t[:], asset.rotation[:], asset.opacity[:] = -1, (1, 0, 0, 0), 1
    asset.scale[:] = (0.1, 0.001, 0.001)
    low, high = extent_of(replace(asset, clip=replace(asset.clip, pixel=0.0)))
    np.testing.assert_allclose([-low, high], [[0.3, 0.3, 0.003]] * 2, atol=1e-4)


def test_positions_that_overflow_are_refused():
    asset = tracked_asset(9)
    asset.paths.place[:] *= np.float32(1e38) / np.abs(asset.paths.place).max() * 3
    with pytest.raises(InputError, match=r"a\.usdc: .* overflow"):
        positions(replace(asset, xyz=-asset.xyz * np.float32(3e38)), False, A)
