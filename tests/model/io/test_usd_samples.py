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
    assert list(positions(asset, False, A))[:: max(places - 1, 1)] == sorted({first, last})[:places]
    assert len(positions(asset, False, A)) == places and len(orientations(asset)) == turns
    assert len(positions(asset, True, A)) == (24 if places > 1 else 1)


def test_samples_are_the_asset_at_its_frames():
    asset = tracked_asset(40, turn=0.6)
    at, turned = positions(asset, False, A), orientations(asset)
    assert list(at) == list(turned) == list(asset.clip.frames)
    for frame, xyz in at.items():
        time = asset.frame_to_time(frame)
        np.testing.assert_array_equal(xyz, asset.at(time)[0])
        np.testing.assert_allclose(
            rotation_matrices(turned[frame]), rotation_matrices(asset.rotation_at(time)), atol=1e-6
        )
    for a, b in zip(asset.clip.frames, asset.clip.frames[1:], strict=False):
        assert ((turned[a] * turned[b]).sum(1) > 0).all()


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
