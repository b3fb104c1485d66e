# SPDX-License-Identifier: GPL-3.0-or-later
"""Disturbances: by how much their level says, and nothing at level 0."""

import numpy as np
import pytest
import torch

from timesplat.evaluation.stress import disturb
from timesplat.evaluation.stress.sweeps import SWEEPS
from timesplat.model.views import Views

CAMERAS = np.array([0, 1, 0, 1, 0, 1, 2, 2])
NONE_AT_ZERO = [s for s in SWEEPS.values() if s.disturb and not s.repeats and s.name not in ("few", "one_sided")]


def make(size=24):
    rng = torch.Generator().manual_seed(0)
    alpha = torch.zeros(8, size, size)
    alpha[:, 6:18, 8:16] = 1
    alpha[:, 6, 8:16] = 0.5
    c2w = torch.eye(4).repeat(8, 1, 1)
    angle = torch.arange(8) * np.pi / 4
    c2w[:, 0, 3], c2w[:, 1, 3] = 3 * torch.sin(angle), -3 * torch.cos(angle)
    intrinsics = torch.tensor([30.0, 30, size / 2, size / 2]).repeat(8, 1)
    time = torch.tensor([-1, -1, -0.5, -0.5, 0.5, 0.5, 1, 1.0])
    return Views(torch.rand(8, size, size, 3, generator=rng), alpha, c2w, intrinsics, time, 0.5)


def through(function, level):
    return function(make(), CAMERAS, level, np.random.default_rng(1))


@pytest.mark.parametrize("sweep", NONE_AT_ZERO, ids=lambda s: s.name)
def test_level_0_changes_nothing_and_others_something(sweep):
    before, same, other = make(), through(sweep.disturb, 0), through(sweep.disturb, sweep.levels[-1])
    for name in ("alpha", "c2w", "intrinsics", "time"):
        assert torch.allclose(getattr(same, name), getattr(before, name), atol=1e-6)
    shown = before.alpha > 0
    assert torch.allclose(same.rgb[shown], before.rgb[shown], atol=1e-6)
    assert any(
        getattr(other, n).shape != getattr(before, n).shape or not torch.equal(getattr(other, n), getattr(before, n))
        for n in ("rgb", "alpha", "c2w", "intrinsics", "time")
    )
    assert all(torch.isfinite(getattr(other, n)).all() for n in ("rgb", "alpha", "c2w", "intrinsics", "time"))
    assert all(x.min() >= 0 and x.max() <= 1 for x in (other.rgb, other.alpha))


def test_cameras_turn_and_move_by_their_level():
    before = make()
    after = through(disturb.turned, 2.0)
    turn = before.c2w[:, :3, :3].transpose(1, 2) @ after.c2w[:, :3, :3]
    angle = torch.rad2deg(torch.arccos(((turn.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2).clamp(-1, 1)))
    assert torch.allclose(angle, torch.tensor(2.0), atol=2e-2)
    moved = through(disturb.misplaced, 4.0).c2w[:, :3, 3] - before.c2w[:, :3, 3]
    assert torch.allclose(moved.norm(dim=1), torch.tensor(0.04 * 3), atol=1e-5)
    assert torch.allclose(through(disturb.zoomed, 10).intrinsics[0], torch.tensor([33.0, 33, 12, 12]))


def test_a_camera_is_one_camera():
    exposed = through(disturb.exposed, 1.0)
    dark = make().rgb < 0.3
    gain = [float((exposed.rgb[i][dark[i]] / make().rgb[i][dark[i]]).median()) for i in range(8)]
    assert gain[0] == pytest.approx(gain[2], rel=1e-3) and gain[0] != pytest.approx(gain[1], rel=1e-2)
    late = through(disturb.late, 1.0)
    assert torch.equal(late.time - make().time, torch.tensor([0.5, 0, 0.5, 0, 0.5, 0, 0, 0]))


def test_masks():
    assert (through(disturb.grown, 2).alpha > 0).sum() == 8 * 16 * 12
    assert torch.allclose(through(disturb.grown, 2).over(), make().over(), atol=1e-6), "what is added is white"
    assert (through(disturb.grown, -2).alpha == 1).sum() == 8 * (12 - 5) * (8 - 4)
    left = (through(disturb.holed, 25).alpha > 0).sum((1, 2)) / (make().alpha > 0).sum((1, 2))
    assert (left <= 0.75).all() and (left > 0.6).all()
    assert (through(disturb.unmasked, 1.0).alpha == 1).all()
    assert through(disturb.unmasked, 1.0).rgb[0, 0, 0].tolist() == pytest.approx([0.5] * 3)


def test_fewer_views():
    assert through(disturb.few, 3).time.tolist() == [-1, 0.5, 1] or len(through(disturb.few, 3)) == 3
    assert len(through(disturb.few, 96)) == 8
    kept = through(disturb.missing, 50)
    assert kept.time.unique().tolist() == [-1, 1], "never the first or the last moment"
    # cameras stand at 0, 45, … 315 degrees
    assert len(through(disturb.one_sided, 135)) == 3 and len(through(disturb.one_sided, 0)) == 8


def test_what_must_make_no_difference():
    order = through(disturb.shuffled, 1)
    assert sorted(order.rgb.sum((1, 2, 3)).tolist()) == pytest.approx(sorted(make().rgb.sum((1, 2, 3)).tolist()))
    off = through(disturb.hair, 1).intrinsics - make().intrinsics
    assert torch.allclose(off[:, 2:].abs(), torch.tensor(0.01), atol=1e-5) and not off[:, :2].any()


def test_jpeg_keeps_what_lies_outside_of_the_mask():
    after = through(disturb.jpeg, 90)
    outside = make().alpha == 0
    assert torch.equal(after.rgb[outside], make().rgb[outside])
