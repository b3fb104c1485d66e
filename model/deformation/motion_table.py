# SPDX-License-Identifier: GPL-3.0-or-later
"""Motion as a table: how far places all over the object go, and how they turn, at moments of the clip.

There are several levels of places, a single one, a dozen, …, some hundreds, whose motions add up: what moves together
is found at once, and by all views, and what moves by itself is left to the fine ones. A table finds fast motion where
a network over place and time (as of SC-GS) stays behind: of running animals 4 dB and more. Where each moment is seen by
a view or two, the motion of a moment is added to one that takes several: what a view does not show is then as
neighbouring times have it.
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
SHARP = 1.0, 0.7  # … and when it is found, where a time is seen by fewer than SEVERAL views, and by more
SEVERAL = 4
SLOW = 4  # moments between those of the slow part


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


def _reach(levels: list[Tensor]) -> list[float]:
    """σ of a place's influence, of each level (P,3): the median distance to the nearest other."""
    apart = (float(torch.cdist(p, p).topk(2, largest=False).values[:, 1].median()) for p in levels[1:])
    return [2.0] + [max(a, 1e-3) for a in apart]


@dataclass
class MotionTable:
    """Where the values are, which are trained: (M+S,P,6), how far a place goes, and the axis about which it turns times
    (for small ones) the angle, 0 at first; smoothed over neighbouring moments. Those of the slow part are added."""

    levels: list[Tensor]  # (P_l,3) places of each, at rest; P in all
    reach: list[float]  # σ of a place's influence, of each level
    moments: Tensor  # (M,) model times, evenly from before -1 to after 1, so that the ends are smoothed like the rest
    slow: Tensor  # (S,) those of the slow part, likewise; none where a time is seen by SEVERAL views

    @staticmethod
    def around(points: Tensor, frames: int, several: bool, generator: torch.Generator) -> MotionTable:
        """For an object of which points (N,3) are known, 1 or more, in a clip of so many frames. several: whether a
        time is seen by SEVERAL views."""
        levels = [spread_points(points, n, generator) for n in LEVELS if n <= len(points)]
        count = min(max(frames, 2), MOMENTS)
        last = 1 + BEYOND * 2 / (count - 1)
        moments = torch.linspace(-last, last, count + 2 * BEYOND)
        slow = torch.linspace(-last, last, 0 if several else -(-(len(moments) - 1) // SLOW) + 1)
        return MotionTable(levels, _reach(levels), moments, slow)

    width: float = WIDTH  # σ of a moment's influence, in moments

    def _share(self, t: Tensor) -> Tensor:
        """t (T,) -> how much each moment counts then (T,M+S), in all 1 of either part."""
        apart = float(self.moments[1] - self.moments[0])
        shares = []
        for moments, width in ((self.moments, self.width), (self.slow, SLOW))[: 1 + bool(len(self.slow))]:
            share = torch.exp(-0.5 * ((t[:, None] - moments) / (width * apart)).square())
            share = share * (share > 1e-3 * share.amax(1, keepdim=True))  # of many, a few
            shares.append(share / share.sum(1, keepdim=True))
        return torch.cat(shares, 1)

    @torch.no_grad()
    def sharpen(self, values: Tensor, width: float) -> None:
        """Has each moment count over a shorter time from now on; values (M+S,P,6) become what they came to at their
        moments, so that the motion stays about as it is."""
        own = len(self.moments)
        values[:own] = torch.einsum("mn,npc->mpc", self._share(self.moments)[:, :own], values[:own])
        self.width = width

    @torch.no_grad()
    def carry_on(self, values: Tensor, beyond: int, back: bool, speed: float) -> None:
        """Changes values (M+S,P,6) of the last `beyond` moments, or of the first where `back`: all goes straight on
        there, at `speed` times the velocity of the two moments (of 3 at least) that come to them."""
        known = values[: len(self.moments)].flip(0) if back else values[: len(self.moments)]
        last = known[-beyond - 1]
        steps = torch.arange(1, beyond + 1)[:, None, None]
        on = last + steps * speed * (last - known[-beyond - 3]) / 2
        if back:
            values[:beyond] = on.flip(0)
        else:
            values[len(self.moments) - beyond : len(self.moments)] = on

    @torch.no_grad()
    def among(self, values: Tensor, points: Tensor, generator: torch.Generator) -> tuple[MotionTable, Tensor]:
        """A table whose places are among points (N,3), 1 or more, and values with which all of these move about as
        they do with `values` (M+S,P,6): as the finest level has it, to which the others will add."""
        levels = [spread_points(points, n, generator) for n in LEVELS if n <= len(points)]
        table = MotionTable(levels, _reach(levels), self.moments, self.slow, self.width)
        weights, moved = self.weights(levels[-1]), table.zeros()
        for m, t in enumerate(self.moments.tolist()):
            place, turn = self.pose(values, weights, levels[-1], t)
            moved[m, -len(place) :] = torch.cat([place - levels[-1], 2 * turn[:, 1:] / turn[:, :1]], 1)
        return table, moved

    def zeros(self) -> Tensor:
        """The values at rest."""
        return torch.zeros(len(self.moments) + len(self.slow), sum(map(len, self.levels)), 6)

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
        now = share.nonzero()[:, 0]
        return Pose.apply(now.int(), share[now], *weights, points, values)
