# SPDX-License-Identifier: GPL-3.0-or-later
"""Motion as a table: how far places all over the object go, and how they turn, at moments of the clip.

There are several levels of places, a single one, a dozen, …, some hundreds, whose motions add up: what moves together
is found at once, and by all views, and what moves by itself is left to the fine ones. A table finds fast motion where
a network over place and time (as of SC-GS) stays behind: of running animals 4 dB and more.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

LEVELS = (1, 12, 48, 192, 600)  # places of each
MOMENTS = 64  # at the most
WIDTH = 1.5  # σ of a moment's influence, in moments: of 1 and of 2 some objects came out worse


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
    """Where the values are, which are trained: `values` (M,C_l,6) of each level, how far a place goes, and
    the axis about which it turns times (for small ones) the angle, 0 at first; smoothed over neighbouring moments."""

    places: list[Tensor]  # (C_l,3) of each level, at rest
    reach: list[float]  # σ of a place's influence, of each level
    moments: Tensor  # (M,) model times, evenly from -1 to 1

    @staticmethod
    def around(points: Tensor, frames: int, generator: torch.Generator) -> MotionTable:
        """For an object of which points (N,3) are known, 1 or more, in a clip of so many frames."""
        places = [spread_points(points, n, generator) for n in LEVELS if n <= len(points)]
        reach = [2.0] + [float(torch.cdist(p, p).topk(2, largest=False).values[:, 1].median()) for p in places[1:]]
        count = min(max(frames, 2), MOMENTS)
        return MotionTable(places, [max(r, 1e-3) for r in reach], torch.linspace(-1, 1, count))

    def zeros(self) -> dict[str, Tensor]:
        """The values at rest, by the names under which they are trained."""
        return {f"motion{i}": torch.zeros(len(self.moments), len(p), 6) for i, p in enumerate(self.places)}

    def weights(self, points: Tensor) -> list[Tensor]:
        """points (C,3) -> of each level how much each of its places moves them, (C,C_l) of sum 1."""
        found = []
        for places, reach in zip(self.places, self.reach, strict=True):
            d = (torch.cdist(points, places) / reach).square()
            w = torch.exp(0.5 * (d.amin(1, keepdim=True) - d))
            found.append(w / w.sum(1, keepdim=True))
        return found

    def pose(self, values: dict[str, Tensor], weights: list[Tensor], points: Tensor, t: float) -> tuple[Tensor, Tensor]:
        """Where points (C,3) with these weights are at time t (C,3), and their unit quaternions (C,4)."""
        apart = 2 / (len(self.moments) - 1)
        near = torch.exp(-0.5 * ((t - self.moments) / (WIDTH * apart)).square())
        near = near / near.sum()
        gone = sum(w @ torch.tensordot(near, values[f"motion{i}"], 1) for i, w in enumerate(weights))
        one = torch.ones_like(gone[:, :1])
        return points + gone[:, :3], F.normalize(torch.cat([one, 0.5 * gone[:, 3:]], -1), dim=-1)
