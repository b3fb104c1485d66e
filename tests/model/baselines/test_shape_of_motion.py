# SPDX-License-Identifier: GPL-3.0-or-later
"""Shape of Motion: its bases follow what moves, rigidly."""

import pytest
import torch

from timesplat.datagen.sequence import InputError
from timesplat.model.baselines.shape_of_motion import Motion, shape_of_motion


def test_bases_follow_what_moves(spheres, quality):
    frames = [f for f in range(0, 24, 3) for _ in range(3)]
    inputs = spheres(frames, [(120 * k + 15 * f, 10) for f in range(0, 24, 3) for k in range(3)], size=32)
    with torch.inference_mode():
        start, scene = shape_of_motion(inputs, steps=0), shape_of_motion(inputs, steps=100)
    assert quality(scene, inputs) > quality(start, inputs) + 5
    # Gaussians that are red belong to the first sphere, whose centre moves (0.46, 0.23, 0) over the clip.
    red = (start.gaussians.rgb[:, 0] > 0.5) & (start.gaussians.rgb[:, 1] < 0.4)
    way = (scene.at(1.0).xyz - scene.at(-1.0).xyz)[red].mean(0)
    assert red.sum() > 100
    torch.testing.assert_close(way, torch.tensor([0.46, 0.23, 0.0]), atol=0.15, rtol=0)


def test_motion_moves_rigidly_and_stands_still_beyond_its_ends(spheres):
    views = spheres([4, 12, 20], size=24)
    scene = shape_of_motion(views, steps=0)
    turn = torch.tensor([0.5**0.5, 0, 0, 0.5**0.5])  # a quarter about z
    bases = torch.tensor([1.0, 0, 0, 0, 0, 0, 0]).repeat(3, scene.bases.shape[1], 1)
    bases[2, :, :4], bases[2, :, 4:] = turn, torch.tensor([0.1, 0.2, 0.3])
    scene = Motion(scene.gaussians, scene.blend, scene.moments, bases)
    first, middle, last = (scene.at(float(t)) for t in views.time)
    x, y, z = first.xyz.unbind(-1)
    torch.testing.assert_close(last.xyz, torch.stack([-y + 0.1, x + 0.2, z + 0.3], -1), atol=1e-5, rtol=0)
    R = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    torch.testing.assert_close(last.covariance3(), R @ first.covariance3() @ R.T, atol=1e-6, rtol=1e-4)
    torch.testing.assert_close(middle.xyz, first.xyz)
    torch.testing.assert_close(scene.at(1.0).xyz, last.xyz)
    half = scene[scene.alive()][::2].to("cpu")
    assert len(half) == (len(scene) + 1) // 2 and len(half.at(0.3)) == len(half)
    with pytest.raises(InputError, match="do not move on straight lines"):
        scene.to_asset(None)
    views.alpha[:] = 0
    assert len(shape_of_motion(views, steps=1)) == 0
