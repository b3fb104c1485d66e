# SPDX-License-Identifier: GPL-3.0-or-later
"""The compiled pose and bending of control points against the same in float64 by torch, values and gradients."""

import torch
import torch.nn.functional as F

from timesplat.model.deformation.posing import Bending, Pose
from timesplat.model.rotations import rotate


def posed(moments, share, index, weight, rest, values):
    now = torch.einsum("k,kpi->pi", share, values[moments])
    done = (weight[..., None] * now[index]).sum(1)
    return rest + done[:, :3], F.normalize(torch.cat([torch.ones_like(done[:, :1]), done[:, 3:] / 2], 1), dim=-1)


def bent(neighbours, rest, place, turn):
    arm = rotate(turn[:, None], rest[neighbours] - rest[:, None])
    return ((place[neighbours] - place[:, None] - arm) ** 2).sum(-1).mean()


def agrees(function, reference, fixed, leaves, told):
    """Whether results and gradients of leaves are those in float64."""
    found = []
    for f, dtype in ((function, torch.float32), (reference, torch.float64)):
        x = [v.to(dtype, copy=True).requires_grad_() for v in leaves]
        rest = [v if not v.is_floating_point() else v.to(dtype) for v in fixed]
        if dtype == torch.float64:
            rest = [v.long() if not v.is_floating_point() else v for v in rest]
        out = f(*rest, *x)
        out = out if isinstance(out, tuple) else (out,)
        sum((a * b.to(dtype)).sum() for a, b in zip(out, told, strict=True)).backward()
        found.append([*out, *(v.grad for v in x)])
    for a, b in zip(*found, strict=True):
        assert (a - b).abs().max() < 3e-6 * b.abs().max()


def test_a_pose_and_its_gradients():
    g = torch.Generator().manual_seed(0)
    moments, share = torch.tensor([2, 3, 5], dtype=torch.int32), torch.tensor([0.2, 0.5, 0.3])
    index = torch.randint(30, (17, 9), generator=g).int()
    weight, rest = torch.rand(17, 9, generator=g), torch.randn(17, 3, generator=g)
    values = torch.randn(7, 30, 6, generator=g)
    told = torch.randn(17, 3, generator=g), torch.randn(17, 4, generator=g)
    agrees(Pose.apply, posed, (moments, share, index, weight, rest), [values], told)


def test_bending_and_its_gradients():
    g = torch.Generator().manual_seed(1)
    rest, place = torch.randn(2, 40, 3, generator=g)
    turn = F.normalize(torch.randn(40, 4, generator=g), dim=-1)
    neighbours = torch.randint(40, (40, 6), generator=g)
    agrees(Bending.apply, bent, (neighbours, rest), [place, turn], (torch.tensor(0.7),))


def test_what_moves_rigidly_is_not_bent():
    g = torch.Generator().manual_seed(2)
    rest = torch.randn(40, 3, generator=g)
    turn = F.normalize(torch.randn(4, generator=g), dim=-1).expand(40, 4).contiguous()
    place = rotate(turn, rest) + torch.tensor([1.0, 2, 3])
    neighbours = torch.randint(40, (40, 6), generator=g)
    assert Bending.apply(neighbours, rest, place, turn) < 1e-10
    assert Bending.apply(neighbours, rest, 1.1 * place, turn) > 1e-3
