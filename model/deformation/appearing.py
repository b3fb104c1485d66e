# SPDX-License-Identifier: GPL-3.0-or-later
"""What comes and goes. A fit begins with what the middle of the clip shows; what is not there yet, or not any more, has
no Gaussian that could become it. So once all of the clip is looked at, points join the cloud where the views about a
moment agree that something is and the cloud shows nothing; each is there for as long as silhouettes have it, before
that moment and after it, and at no other time."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from ..fitting.loop import draw
from ..geometry.silhouettes import HALF_SIDE, seen_inside
from ..views import Views
from .cloud import DeformingCloud

TRIED, ROUNDS = 10_000, 10  # random points at a time, and how often, where some of the first are missing
AT_ONCE = 64  # views that are drawn at a time
FRAMED = 0.5  # share of the views about a moment that must frame a point; …
AGREE = 0.7  # … of these that must miss it, …
UNSHOWN = 0.3  # … which they do where the cloud's alpha is below this
INSIDE = 0.9  # share of a moment's views that must have a point inside of the silhouette, while it is there
EVER = 2.0  # model time that is not reached, before the clip and after it


@torch.no_grad()
def unshown(cloud: DeformingCloud, views: Views) -> Views:
    """The views with nothing in their silhouettes but what the cloud does not show."""
    parts = torch.arange(len(views)).split(AT_ONCE)
    alpha = torch.cat([draw(cloud, views[part], torch.zeros(3), 0.0).alpha for part in parts])
    return replace(views, alpha=views.alpha * (alpha < UNSHOWN))


def missing_points(left: Views, t: float, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Views from `unshown` -> random points (N,3) that the `count` of them that are nearest to time t agree on, or all
    of that moment, and their colours (N,3)."""
    order = (left.time - t).abs().argsort(stable=True)
    near = left[order[: max(count, int((left.time == t).sum()))]]
    found: list[Tensor] = []
    for _ in range(ROUNDS):
        points = HALF_SIDE * (2 * torch.rand(TRIED, 3, generator=generator) - 1)
        framed, seen, rgb = seen_inside(near, points)
        missing = (framed >= FRAMED * len(near)) & (seen >= AGREE * framed)
        found.append(torch.cat([points, rgb], 1)[missing])
        if not len(found[0]):
            break
    return torch.cat(found).split(3, 1)


def lives(cloud: DeformingCloud, xyz: Tensor, views: Views, t: float) -> Tensor:
    """xyz (N,3) at rest of what is there at t, the time of one of the views -> (N,2) from when to when it is, model
    time: until half-way to the first moment at which it would be outside of the silhouette."""
    moments = views.time.unique()
    inside = []
    for m in moments.tolist():
        framed, seen, _ = seen_inside(views[(views.time == m).nonzero()[:, 0]], cloud.moved(xyz, m)[0])
        inside.append((seen >= INSIDE * framed) | (m == t))
    now, there = int((moments == t).nonzero()[0, 0]), torch.stack(inside, 1).long()
    before = there[:, : now + 1].flip(1).cumprod(1).sum(1)
    after = there[:, now:].cumprod(1).sum(1)
    ever = moments.new_tensor([EVER])
    ends = torch.cat([-ever, 0.5 * (moments[1:] + moments[:-1]), ever])
    return torch.stack([ends[now + 1 - before], ends[now + after]], 1)
