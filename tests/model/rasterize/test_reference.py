# SPDX-License-Identifier: GPL-3.0-or-later
"""The reference against mathematics."""

from dataclasses import replace

import torch

from timesplat.model.rasterize import render

from .scenes import AXIS, FIELDS, plane


def test_gradients_by_finite_differences():
    g = replace(
        plane(4, 2.0, scale=(0.05, 0.3)),
        velocity=torch.tensor([[0.1, -0.2, 0.3]]).repeat(4, 1),
        sigma_t=torch.full((4,), 0.9),
    ).to(torch.float64)
    intrinsics, time = torch.tensor([[5.0, 6.0, 3.1, 2.2]]), torch.tensor([0.2], dtype=torch.float64)

    def draw(*values):
        changed = replace(g, **dict(zip(FIELDS, values, strict=True)))
        return render(changed, AXIS[0].double(), intrinsics.double(), time, 6, 5, backend="reference")

    leaves = [getattr(g, k).clone().requires_grad_() for k in FIELDS]
    assert torch.autograd.gradcheck(draw, leaves, eps=1e-6, atol=1e-6)
