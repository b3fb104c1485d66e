# SPDX-License-Identifier: GPL-3.0-or-later
"""Adaptive density, as in 3DGS: now and then the faint are removed, and those whose position the views pull at
hardest are split in two."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from ..rotations import rotation_matrix
from .parameters import Parameters

EVERY, UNTIL = 40, 0.6  # steps between densifications, and the share of the budget after which there are none
SHARE = 0.05  # of the Gaussians are split each time
LARGEST_SHARE = 1 / 3  # that is split at once where as many as possible are wanted
SHRINK = 1.6  # a split Gaussian's parts are smaller by this
FAINT = 0.02  # opacity below which a Gaussian is removed
OUTSIDE = 1.2  # or when its centre left the box this far


@dataclass(frozen=True)
class Pace:
    """How often there are more, and how many."""

    every: int = EVERY  # steps between densifications
    since: float = 0.0  # share of the budget before which there are none …
    until: float = UNTIL  # … and after which
    share: float | None = SHARE  # that is split each time; None: as many as lead to the most that there may be

    def share_now(self, step: int, fraction: float, count: int, most: int) -> float:
        """Of `count` Gaussians, after so many steps, where there may be `most`."""
        if self.share is not None:
            return self.share
        left = max((self.until - fraction) / (self.every * fraction / step), 1.0)  # densifications
        return min(1.5 * (most - count) / left / count, LARGEST_SHARE)  # more at first, as some fade


PACE = Pace()


class Densifier:
    """Accumulates the positional gradients of a fit's steps, and densifies by them."""

    def __init__(
        self,
        parameters: Parameters,
        generator: torch.Generator,
        max_gaussians: int,
        pace: Pace = PACE,
        outside: float = OUTSIDE,
    ):
        """outside: half the side of the box beyond which Gaussians are lost."""
        self.parameters, self.generator, self.max_gaussians, self.pace = parameters, generator, max_gaussians, pace
        self.outside = outside
        self._restart()

    def _restart(self) -> None:
        self.grad_accum = torch.zeros_like(self.parameters["opacity"].detach())  # (N,) since the last densification

    def after_backward(self, step: int, fraction: float) -> bool:
        """To be called after the gradients of each step (counted from 1) are there, and before they are used; ->
        whether the rows are others now."""
        pace, p = self.pace, self.parameters
        self.grad_accum += p["xyz"].grad.norm(dim=-1)
        if step % pace.every or not pace.since <= fraction < pace.until:
            return False
        share = pace.share_now(step, fraction, len(self.grad_accum), self.max_gaussians)
        densify(p, self.grad_accum, self.generator, self.max_gaussians, share, self.outside)
        self._restart()
        return True


@torch.no_grad()
def densify(
    p: Parameters,
    grad_accum: Tensor,
    generator: torch.Generator,
    max_gaussians: int,
    share: float = SHARE,
    outside: float = OUTSIDE,
) -> None:
    """Removes the faint and the lost, and splits the share of the rest with the largest accumulated gradients
    (grad_accum (N,)) in two: smaller, and apart by a random step within the Gaussian, so that both together look
    about as it did; never more than `max_gaussians` in all."""
    keep = (torch.sigmoid(p["opacity"]) > FAINT) & (p["xyz"].abs().amax(-1) < outside)
    kept = keep.nonzero()[:, 0]
    n = len(kept)
    count = max(min(int(share * n), max_gaussians - n), 0)
    split = grad_accum[kept].topk(count).indices
    p.keep_rows(torch.cat([kept, kept[split]]))
    both = torch.cat([split, torch.arange(n, n + count, device=split.device)])
    scale, rotation = p["scale"][split].exp(), F.normalize(p["rotation"][split], dim=-1)
    step = torch.randn(count, 3, generator=generator).to(scale) * scale
    step = (rotation_matrix(rotation) @ step[..., None])[..., 0]
    p["xyz"][both] += torch.cat([step, -step])
    p["scale"][both] -= torch.tensor(SHRINK).log()
    p.reset_moments(both)
