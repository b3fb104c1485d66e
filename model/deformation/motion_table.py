# SPDX-License-Identifier: GPL-3.0-or-later
"""Motion as a table: how far places all over the object go, and how they turn, at moments of the clip.

There are several levels of places, a single one, a dozen, …, some hundreds, whose motions add up: what moves together
is found at once, and by all views, and what moves by itself is left to the fine ones. A table finds fast motion where
a network over place and time (as of SC-GS) stays behind: of running animals 4 dB and more.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from .posing import Pose

LEVELS = (1, 12, 48, 192, 600)  # places of each
MOMENTS = 40  # at the most
NEAREST = 8  # places of a level that move a point
BEYOND = 2  # moments before the clip, and after it
WIDTH = 1.5  # σ of a moment's influence, in moments, while motion is looked for …
SHARP = 1.0, 0.7  # … and when it is found, where a time is seen by one view, and by SEVERAL
SEVERAL = 4


def spread_points(points: Tensor, count: int, generator: torch.Generator, among: int = 20_000) -> Tensor:
    """points (N,3) -> at most `count` of them (C,3) that lie far apart, by farthest-point sampling among some."""
    if len(points) > among:
        points = points[torch.randperm(len(points), generator=generator)[:among]]
    chosen, nearest = int(torch.randint(len(points), (), generator=generator)), torch.full((len(points),), torch.inf)
    taken = []
    for _ in range(min(count, len(points))):
        taken.append(chosen)
        nearest = torch.minimum(nearest, (points - points[chosen]).square().sum(-1))
        chosen = int(nearest.argmax())
    return points[taken]


@dataclass
class MotionTable:
    """Where the values are, which are trained: (M,P,6), how far a place goes, and the axis about which it turns times
    (for small ones) the angle, 0 at first; smoothed over neighbouring moments."""

    levels: list[Tensor]  # (P_l,3) places of each, at rest; P in all
    reach: list[float]  # σ of a place's influence, of each level
    moments: Tensor  # (M,) model times, evenly from before -1 to after 1, so that the ends are smoothed like the rest

    @staticmethod
    def around(points: Tensor, frames: int, generator: torch.Generator) -> MotionTable:
        """For an object of which points (N,3) are known, 1 or more, in a clip of so many frames."""
        levels = [spread_points(points, n, generator) for n in LEVELS if n <= len(points)]
        reach = [2.0] + [float(torch.cdist(p, p).topk(2, largest=False).values[:, 1].median()) for p in levels[1:]]
        count = min(max(frames, 2), MOMENTS)
        last = 1 + BEYOND * 2 / (count - 1)
        return MotionTable(levels, [max(r, 1e-3) for r in reach], torch.linspace(-last, last, count + 2 * BEYOND))

    width: float = WIDTH  # σ of a moment's influence, in moments

    def _share(self, t: Tensor) -> Tensor:
        """t (T,) -> how much each moment counts then (T,M), in all 1."""
        apart = float(self.moments[1] - self.moments[0])
        share = torch.exp(-0.5 * ((t[:, None] - self.moments) / (self.width * apart)).square())
        return share / share.sum(1, keepdim=True)

    @torch.no_grad()
    def sharpen(self, values: Tensor, width: float) -> None:
        """Has each moment count over a shorter time from now on; values (M,P,6) become what they came to at their
        moments, so that the motion stays about as it is."""
        values.copy_(torch.einsum("mn,npc->mpc", self._share(self.moments), values))
        self.width = width

    def zeros(self) -> Tensor:
        """The values at rest."""
        return torch.zeros(len(self.moments), sum(map(len, self.levels)), 6)

    def weights(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """points (C,3) -> the places that move each (C,S) int32, the NEAREST of each level, and how much (C,S): of a
        level in all 1."""
        first, index, weight = 0, [], []
        for places, reach in zip(self.levels, self.reach, strict=True):
            d = torch.cdist(points, places).topk(min(NEAREST, len(places)), largest=False)
            w = torch.exp(0.5 * (d.values[:, :1].square() - d.values.square()) / reach**2)
            index.append(first + d.indices)
            weight.append(w / w.sum(1, keepdim=True))
            first += len(places)
        return torch.cat(index, 1).int(), torch.cat(weight, 1)

    def pose(self, values: Tensor, weights: tuple[Tensor, Tensor], points: Tensor, t: float) -> tuple[Tensor, Tensor]:
        """Where points (C,3) with these weights are at time t (C,3), and their unit quaternions (C,4)."""
        share = self._share(torch.tensor([t]))[0]
        now = (share > 1e-3 * share.max()).nonzero()[:, 0]
        return Pose.apply(now.int(), share[now] / share[now].sum(), *weights, points, values)
