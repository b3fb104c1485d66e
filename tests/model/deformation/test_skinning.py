# SPDX-License-Identifier: GPL-3.0-or-later
"""The compiled skinning against the same in float64 by torch, places and gradients."""

import torch
import torch.nn.functional as F

from timesplat.model.deformation.skinning import CHUNK, Skin
from timesplat.model.rotations import quaternion_multiply, rotate


def skinned(near, weight, rest, place, turn, xyz, rotation):
    arm = rotate(turn[near], xyz[:, None] - rest[near])
    moved = (weight[..., None] * (place[near] + arm)).sum(1)
    blend = (weight[..., None] * turn[near]).sum(1)
    return moved, F.normalize(quaternion_multiply(blend, rotation), dim=-1)


def test_places_and_gradients_are_those_of_autograd():
    g = torch.Generator().manual_seed(0)
    count, control = CHUNK + 37, 20  # two jobs
    near = torch.randint(control, (count, 4), generator=g)
    weight = torch.rand(count, 4, generator=g)
    weight = weight / weight.sum(1, keepdim=True)
    rest, place = torch.randn(2, control, 3, generator=g)
    turn = F.normalize(torch.randn(control, 4, generator=g) + torch.tensor([3.0, 0, 0, 0]), dim=-1)
    xyz = torch.randn(count, 3, generator=g)
    rotation = F.normalize(torch.randn(count, 4, generator=g), dim=-1)
    out = torch.randn(count, 3, generator=g), torch.randn(count, 4, generator=g)

    def run(function, index, dtype):
        leaves = [x.detach().to(dtype, copy=True).requires_grad_() for x in (place, turn, xyz, rotation)]
        results = function(index, weight.to(dtype), rest.to(dtype), *leaves)
        sum((a * b.to(dtype)).sum() for a, b in zip(results, out, strict=True)).backward()
        return [*results, *(x.grad for x in leaves)]

    told, exact = run(Skin.apply, near.int(), torch.float32), run(skinned, near, torch.float64)
    for a, b in zip(told, exact, strict=True):
        assert (a - b).abs().max() < 2e-6 * b.abs().max()
