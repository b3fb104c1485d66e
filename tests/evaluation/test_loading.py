# SPDX-License-Identifier: GPL-3.0-or-later
"""Inputs and truth: sizes are averages, moments and thinned clips move as they should."""

import numpy as np
import pytest
import torch

from timesplat.datagen.sequence import InputError, read_sequence
from timesplat.evaluation import protocol
from timesplat.evaluation.loading import collapsed, load_truth, thinned
from timesplat.evaluation.scoring import score
from timesplat.model.geometry.lift import lift
from timesplat.model.views import load_views


def test_smaller_sizes_are_averages(sphere_folder):
    seq = read_sequence(sphere_folder)
    targets = seq.select(rig="target")
    truth, half = load_truth(seq, targets, targets), load_truth(seq, targets, targets[:1], 16)
    assert half.picture.shape == (6, 16, 16, 3) and half.novel.tolist() == [True] + [False] * 5
    blocks = truth.picture.reshape(6, 16, 2, 16, 2, 3).mean((2, 4))
    assert torch.allclose(half.picture, blocks, atol=1e-6)
    assert torch.allclose(half.views.intrinsics * 2, truth.views.intrinsics)
    has_depth, without = (load_views(seq, range(24), depth, 16) for depth in (True, False))
    assert torch.equal(has_depth.rgb, without.rgb) and without.depth is None and has_depth.depth is not None
    assert torch.allclose(without.over(1.0), load_truth(seq, range(24), [], 16).picture, atol=1e-5)
    with pytest.raises(InputError, match="do not shrink to 20"):
        load_views(seq, range(24), False, 20)


def test_a_thinned_clip_moves_at_the_same_speed(spheres):
    views = spheres([0, 4, 8], size=16)
    thin = thinned(views, 4)
    torch.testing.assert_close(thin.flow / thin.frame_step, views.flow / views.frame_step)
    assert thin.frame_step == pytest.approx(8 / 23)


def test_one_moment_is_reconstructed_still(evaluation_folder):
    seq = read_sequence(evaluation_folder)
    g = lift(collapsed(load_views(seq, protocol.at_frame(seq, 12, "canonical"), True)))
    assert (g.velocity == 0).all() and (g.t == 0).all() and len(g) > 100


def test_views_without_masks_are_compared_inside_the_hull_alone(sphere_folder):
    """What is outside is white, in truth and in prediction, and costs nothing."""
    seq = read_sequence(sphere_folder)
    targets = seq.select(rig="target")
    hull = np.zeros((seq.height, seq.width), np.uint8)
    hull[: seq.height // 2] = 255
    seq.hull = lambda i: hull if i == targets[0] else None
    plain, truth = (load_truth(s, targets, targets, 16) for s in (read_sequence(sphere_folder), seq))
    assert plain.inside is None and truth.inside.shape == (6, 16, 16)
    assert truth.inside[0].sum() == 128 and truth.inside[1:].min() == 1
    assert (truth.picture[0, 8:] == 1).all() and torch.equal(truth.picture[0, :8], plain.picture[0, :8])
    assert torch.equal(truth.picture[1:], plain.picture[1:])
    scene = lift(load_views(seq, range(8), True, 16))
    whole, inside = (score(scene, t, ("lpips", "flip")) for t in (plain, truth))
    assert whole["psnr"][1:] == inside["psnr"][1:] and whole["psnr"][0] != inside["psnr"][0]
    missed = score(scene[:0], truth, ("lpips", "flip"))["psnr"][0]
    assert missed < inside["psnr"][0]
