# SPDX-License-Identifier: GPL-3.0-or-later
"""Many Gaussians into few: how much each contributes to pictures, and merging by moment matching.

A network or lift gives one Gaussian or several per pixel of every view: the same surface again and again, from
each camera and at each time. Those that share a place are merged into one that has their moments. What does not
move through the clip is merged over all of it, into Gaussians with long lives.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from ..gaussians import Gaussians4D
from ..rasterize import render
from ..rotations import scale_rotation_from_covariance
from ..tracks import Tracks4D
from ..views import Views
from .loop import gradients

MOMENTS = 6  # parts of the clip within which what moves is merged
HALVINGS = 16  # of the interval in which the cells' side is looked for


def contribution(g: Gaussians4D | Tracks4D, views: Views) -> Tensor:
    """(N,) the sum over all pixels of `views` of the weight with which each Gaussian is blended there: what is
    hidden from them all, or lives at other times, has 0. It is the gradient of the pictures' sum by the colour."""
    height, width = views.size
    with gradients():
        rgb = torch.zeros_like(g.rgb).requires_grad_()
        here = replace(g, rgb=rgb)
        if isinstance(here, Gaussians4D):
            here = here.map(torch.clone)
        picture, _ = render(here, views.c2w, views.intrinsics, views.time, width, height, background=0.0)
        (grad,) = torch.autograd.grad(picture[..., 0].sum(), rgb)
    return grad[:, 0]


@torch.no_grad()
def merge_gaussians(g: Gaussians4D, count: int) -> Gaussians4D:
    """About `count` Gaussians, 1 or more, of N (all, if they are no more). Those are merged whose centres share a cell
    of a grid in space, at the middle of one of MOMENTS parts of the clip; those that stay in their cell all the time,
    over the whole clip. The share of each is what it covers, for as long as it lives, times its opacity."""
    if len(g) <= count:
        return g
    g = g.with_axes()
    seen = _seen(g.opacity, g.scale, g.sigma_t)
    weight = seen + 1e-9 * seen.mean() + 1e-30
    owner, n = _cells(g, count)
    total = weight.new_zeros(n).index_add(0, owner, weight)

    def mean(x: Tensor) -> Tensor:
        w = weight.view(-1, *[1] * (x.ndim - 1))
        return x.new_zeros(n, *x.shape[1:]).index_add(0, owner, x * w) / total.view(-1, *[1] * (x.ndim - 1))

    t, velocity = mean(g.t), mean(g.velocity)
    centre = g.position(t[owner])
    xyz = mean(centre)
    off = centre - xyz[owner]
    scale, rotation = scale_rotation_from_covariance(mean(g.covariance3() + off[:, :, None] * off[:, None]))
    sigma_t = mean(g.sigma_t.square() + (g.t - t[owner]).square()).sqrt()
    mass = g.t.new_zeros(n).index_add(0, owner, seen)
    opacity = (mass / _seen(1.0, scale, sigma_t)).clamp(0.05, 0.9)
    return Gaussians4D(xyz, t, velocity, sigma_t, scale, rotation, mean(g.rgb), opacity)


def _cells(g: Gaussians4D, count: int) -> tuple[Tensor, int]:
    """The cell (N,) of each Gaussian, and how many cells there are: the side is looked for at which these are about
    `count`."""
    part = ((g.t.clamp(-1, 1) + 1) / 2 * MOMENTS).floor().clamp_max(MOMENTS - 1)
    middle = (part + 0.5) / MOMENTS * 2 - 1
    way = 2 * g.velocity.norm(dim=-1)  # through the clip
    small, large = 1e-3, 1.0
    for _ in range(HALVINGS):
        side = (small * large) ** 0.5
        still = way < 0.5 * side
        place = torch.where(still[:, None], g.xyz, g.position(middle))
        when = torch.where(still, -1.0, part)
        cell = torch.cat([(place / side).floor(), when[:, None]], -1).long().clamp(-(2**14), 2**14 - 1) + 2**14
        key = ((cell[:, 0] * 2**15 + cell[:, 1]) * 2**15 + cell[:, 2]) * 2**15 + cell[:, 3] - 2**14
        _, owner = key.unique(return_inverse=True)
        n = int(owner.max()) + 1
        small, large = (side, large) if n > count else (small, side)
    return owner, n


def _seen(opacity, scale: Tensor, sigma_t: Tensor) -> Tensor:
    """(N,) about how much is seen of Gaussians for how long: their two longer axes, opacity and lifetime."""
    return opacity * scale.prod(-1) / scale.amin(-1).clamp_min(1e-12) * sigma_t
