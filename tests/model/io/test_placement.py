# SPDX-License-Identifier: GPL-3.0-or-later
"""An asset at another place in the world."""

from dataclasses import replace

import numpy as np
import pytest

from timesplat.datagen.sequence import InputError
from timesplat.model.io.asset import ARRAYS, Asset, Clip, check, rotation_matrices
from timesplat.model.io.pieces import to_pieces
from timesplat.model.io.placement import place_asset, rest_and_motion

from ...assets import make_asset, tracked_asset

CLIP = Clip(25.0, 3, 12, 2.5, (1.0, -2.0, 3.0), pixel=0.02)


def covariance(asset: Asset) -> np.ndarray:
    M = rotation_matrices(asset.rotation.astype(float)) * asset.scale[:, None, :]
    return M @ M.transpose(0, 2, 1)


def rotation_of(seed: int) -> np.ndarray:
    q = np.random.default_rng(seed).normal(size=(1, 4))
    return rotation_matrices(q / np.linalg.norm(q))[0]


SHEAR = np.array([[1.0, 0.3, 0], [0, 0.7, 0.1], [0, 0, 1.9]])


@pytest.mark.parametrize(
    "A",
    [3.0 * np.eye(3), rotation_of(1) * 0.2, rotation_of(2) @ SHEAR, np.diag([-2.0, 2, 2]), np.diag([-1.0, 2, -3])],
    ids=["scale", "rotation", "shear", "mirror", "unequal"],
)
def test_placed_is_the_matrix(A):
    """At every moment, positions and covariances in the world are those of the matrix."""
    asset = make_asset(50, clip=CLIP)
    M = np.eye(4)
    M[:3, :3], M[:3, 3] = A, [4, 5, -6]
    out = place_asset(asset, M)
    check(out)
    c = out.clip
    assert c.translation == (4, 5, -6) and np.isclose(c.scale**3, abs(np.linalg.det(A)))
    for time in (-1.0, 0.3, 1.0):
        (p, o), (q, u) = asset.at(time), out.at(time)
        np.testing.assert_allclose(q * c.scale + c.translation, p @ A.T + [4, 5, -6], atol=2e-5)
        np.testing.assert_array_equal(o, u)
    want = A @ covariance(asset.softened()) @ A.T
    got = covariance(out.softened()) * c.scale**2
    np.testing.assert_allclose(got, want, rtol=1e-3, atol=1e-6 * np.abs(want).max())


@pytest.mark.parametrize("A", [rotation_of(1) * 0.2, np.diag([-2.0, 2, 2]), -3 * rotation_of(5)])
def test_paths_are_placed_too(A):
    """At every moment, those of Gaussians that turn: rotated, and in a mirror."""
    asset, M = tracked_asset(30, clip=CLIP, turn=0.5), np.eye(4)
    M[:3, :3], M[:3, 3] = A, [4, 5, -6]
    out = place_asset(asset, M)
    check(out)
    assert len(out.paths) == len(asset.paths)
    np.testing.assert_allclose(out.path_velocity(), out.velocity, atol=1e-4)
    for time in (-1.0, -0.4, 0.3, 1.0):
        (p, o), (q, u) = asset.at(time), out.at(time)
        np.testing.assert_allclose(q * out.clip.scale + out.clip.translation, p @ A.T + [4, 5, -6], atol=2e-5)
        np.testing.assert_array_equal(o, u)
        before, after = (covariance(replace(a.softened(), rotation=a.rotation_at(time))) for a in (asset, out))
        want = A @ before @ A.T
        np.testing.assert_allclose(after * out.clip.scale**2, want, rtol=1e-3, atol=1e-5 * np.abs(want).max())


def test_what_turns_is_placed_by_unequal_scales_in_pieces():
    asset = tracked_asset(30, clip=CLIP, turn=0.5)
    out, want = place_asset(asset, np.diag([1.0, 2, 3, 1])), to_pieces(asset)
    assert out.paths is None and out.path is None
    scale, translation = out.clip.scale, out.clip.translation
    np.testing.assert_allclose(out.at(0.2)[0] * scale + translation, want.at(0.2)[0] * [1, 2, 3], atol=1e-4)


def test_placed_leaves_alone_what_needs_no_change():
    asset = make_asset(5, clip=CLIP)
    M = np.diag([2.5, 2.5, 2.5, 1])
    M[:3, 3] = 1, -2, 3
    same = place_asset(asset, M)
    assert same.clip == CLIP and all(getattr(same, k) is getattr(asset, k) for k in ARRAYS)
    turned = place_asset(asset, np.block([[rotation_of(3), np.zeros((3, 1))], [np.zeros((1, 3)), 1]]))
    assert turned.scale is asset.scale and turned.clip.pixel == CLIP.pixel
    for flat in (np.diag([1.0, 1, 0, 1]), np.full((4, 4), np.nan)):
        with pytest.raises(InputError, match="scaled to nothing"):
            place_asset(asset, flat)


def test_rest_and_motion():
    """Together they are where it is at each frame; it rests where it has half of its size."""
    grows = np.stack([np.diag([f, f, f, 1.0]) for f in (0.01, 0.6, 1)])
    grows[:, :3, 3] = rotation_of(4)
    rest, motion = rest_and_motion(grows)
    np.testing.assert_array_equal(rest, grows[1])
    np.testing.assert_allclose(motion @ rest, grows, atol=1e-12)
    rest, motion = rest_and_motion(grows[[1, 1]])
    assert motion is None and (rest == grows[1]).all()
    for flat in (np.zeros((2, 4, 4)), grows * np.nan):
        with pytest.raises(InputError, match="scaled to nothing"):
            rest_and_motion(flat)
