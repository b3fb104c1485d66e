# SPDX-License-Identifier: GPL-3.0-or-later
"""What silhouettes say of where an object is, and of its colour there."""

from __future__ import annotations

import torch
from torch import Tensor

from ..views import Views

MOST_VIEWS = 48  # that are looked at, spread over those given
HALF_SIDE = 1.1  # of the cube in which the object is, centred at the origin
LEAST_SHARE = 1e-3  # of the cube that must be inside of the silhouettes
FRAMED = 0.25  # share of the views that must have a point within their frame: some see a part of the object alone


def points_inside(views: Views, count: int, generator: torch.Generator, share: float = 0.9) -> tuple[Tensor, Tensor]:
    """`count` random points (N,3) that so large a share of the views (1 or more) that frame them sees inside the
    object's silhouette, and the mean colour (N,3) in which they see it there. Where next to nothing is, as of an
    object that moves while the views are taken, the share is lowered until something is: anywhere in the end."""
    chosen = views[torch.linspace(0, len(views) - 1, min(MOST_VIEWS, len(views))).round().long()]
    found, total, tried = [], 0, max(4 * count, 10_000)
    while total < count:
        points = HALF_SIDE * (2 * torch.rand(tried, 3, generator=generator) - 1)
        framed, seen, colour = seen_inside(chosen, points)
        inside = (framed >= FRAMED * len(chosen)) & (seen >= share * framed) | (share <= 0)
        if inside.sum() < LEAST_SHARE * tried:
            share -= 0.1
            continue
        found.append(torch.cat([points, colour], 1)[inside])
        total += int(inside.sum())
    return torch.cat(found)[:count].split(3, 1)


def seen_inside(views: Views, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """points (N,3) -> in how many views each is within the frame (N,), in how many of these inside the silhouette
    (N,), and the mean colour there (N,3)."""
    height, width = views.size
    framed, seen = torch.zeros(len(points)), torch.zeros(len(points))
    total, colour = torch.zeros(len(points), 1), torch.zeros(len(points), 3)
    for v in range(len(views)):
        local = (points - views.c2w[v, :3, 3]) @ views.c2w[v, :3, :3]
        x, y = (local[:, :2] / local[:, 2:] * views.intrinsics[v, :2] + views.intrinsics[v, 2:]).unbind(1)
        there = (local[:, 2] > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height)
        row, column = y.clamp(0, height - 1).long(), x.clamp(0, width - 1).long()
        alpha = views.alpha[v, row, column] * there
        framed += there
        seen += alpha > 0.5
        total += alpha[:, None]
        colour += alpha[:, None] * views.rgb[v, row, column]
    return framed, seen, colour / total.clamp_min(1e-6)
