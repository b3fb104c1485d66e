# SPDX-License-Identifier: GPL-3.0-or-later
"""Scenes without an end: pictures in which all that is seen counts, walls and hills far outside of the volume too.

Space is contracted as in mip-NeRF 360 (Barron et al. 2022): what lies within the unit ball stays where it is, all that
is outside of it comes to lie between radius 1 and 2.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..views import Views, rays

EDGE = 2.0  # radius at which contracted space ends
FARTHEST = 50.0  # where points are looked for, in the volume's half sides
WHOLE = 0.9  # share of the pixels that show something, from which on there is no object apart from what is around it
DEPTHS = 48  # that are tried along a ray, as even in contracted space as can be
MOST_VIEWS = 24  # that are asked whether they see the same colour there
FEWEST_SEEN = 2  # of them, for a depth to be believed


def is_whole(views: Views) -> bool:
    """Whether these views show a scene, and not an object with nothing behind it."""
    return float((views.alpha > 0.5).float().mean()) >= WHOLE


def expanded(contracted: Tensor) -> tuple[Tensor, Tensor]:
    """Places (N,3) in contracted space, within a ball of radius 2 -> the places (N,3), and by how much what is small
    there is larger (N,1), seen from the middle."""
    r = contracted.norm(dim=-1, keepdim=True).clamp_min(1e-9)
    out = 1 / (EDGE - r.clamp(max=EDGE - 1 / (2 * FARTHEST)))
    larger = torch.where(r > 1, out / r, torch.ones_like(r))
    return contracted * larger, larger


def contracted(places: Tensor) -> Tensor:
    """(N,3) -> (N,3), of which `expanded` makes the places again."""
    r = places.norm(dim=-1, keepdim=True).clamp_min(1e-9)
    return torch.where(r > 1, places * (EDGE - 1 / r) / r, places)


def points_around(views: Views, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """`count` points (N,3) in contracted space, and their colours (N,3): each on the ray through a random pixel of a
    random view, where the other views see most nearly its colour; at any depth, where fewer than FEWEST_SEEN look."""
    height, width = views.size
    of = torch.randint(len(views), (count,), generator=generator)
    row, column = (torch.randint(n, (count,), generator=generator) for n in (height, width))
    asked = torch.linspace(0, len(views) - 1, min(MOST_VIEWS, len(views))).round().long().tolist()
    origin, direction = torch.empty(count, 3), torch.empty(count, 3)
    for v in of.unique().tolist():
        mine = of == v
        o, d = rays(views.c2w[v : v + 1], views.intrinsics[v : v + 1], height, width)
        origin[mine], direction[mine] = (x[0, row[mine], column[mine]] for x in (o, d))
    colour = views.rgb[of, row, column]
    share = (torch.arange(DEPTHS) + torch.rand(count, DEPTHS, generator=generator)) / DEPTHS
    distance = _distances(origin.norm(dim=-1, keepdim=True), share)
    places = origin[:, None] + distance[..., None] * direction[:, None]  # (N,D,3)
    unlike, seen = torch.zeros(count, DEPTHS), torch.zeros(count, DEPTHS)
    for v in asked:
        local = (places - views.c2w[v, :3, 3]) @ views.c2w[v, :3, :3]
        x, y = (local[..., :2] / local[..., 2:] * views.intrinsics[v, :2] + views.intrinsics[v, 2:]).unbind(-1)
        there = (local[..., 2] > 1e-3) & (x >= 0) & (x < width) & (y >= 0) & (y < height) & (of != v)[:, None]
        at = views.rgb[v, y.clamp(0, height - 1).long(), x.clamp(0, width - 1).long()]
        # Of those behind something else the colour is another; so differences count up to a limit.
        unlike += (at - colour[:, None]).abs().mean(-1).clamp(max=0.2) * there
        seen += there
    mean = torch.where(seen >= FEWEST_SEEN, unlike / seen.clamp_min(1), torch.full_like(seen, 0.2))
    mean += 1e-4 * torch.rand(mean.shape, generator=generator)
    best = mean.argmin(1)
    return contracted(places[torch.arange(count), best]), colour


def _distances(from_middle: Tensor, share: Tensor) -> Tensor:
    """from_middle (N,1), of the cameras; share (N,D) 0..1 -> distances (N,D) along their rays: even as far as the other
    side of the volume, and ever longer steps from there to FARTHEST."""
    near = from_middle + 1
    inside, outside = 2 * share * near, near / (1 - (2 * share - 1) * (1 - near / (FARTHEST + near)))
    return torch.where(share < 0.5, inside, outside).clamp_min(0.05)
