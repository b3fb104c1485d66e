# SPDX-License-Identifier: GPL-3.0-or-later
"""Adaptive density, as in 3DGS: now and then the faint are removed, and those whose position the views pull at
hardest are split in two."""

from __future__ import annotations

import torch
from torch import Tensor

from ..rotations import rotation_matrix
from .parameters import Parameters, activate

EVERY, UNTIL = 40, 0.6  # steps between densifications, and the share of the budget after which there are none
SHARE = 0.05  # of the Gaussians are split each time
SHRINK = 1.6  # a split Gaussian's parts are smaller by this
FAINT = 0.02  # opacity below which a Gaussian is removed
OUTSIDE = 1.2  # or when its centre left the box this far


class Densifier:
    """Accumulates the positional gradients of a fit's steps, and densifies by them."""

    def __init__(self, parameters: Parameters, generator: torch.Generator, max_gaussians: int):
        self.parameters, self.generator, self.max_gaussians = parameters, generator, max_gaussians
        self._restart()

    def _restart(self) -> None:
        self.grad_accum = torch.zeros_like(self.parameters["t"].detach())  # (N,) since the last densification

    def after_backward(self, step: int, fraction: float) -> None:
        """To be called after the gradients of each step (counted from 1) are there, and before they are used."""
        self.grad_accum += self.parameters["xyz"].grad.norm(dim=-1)
        if step % EVERY == 0 and fraction < UNTIL:
            densify(self.parameters, self.grad_accum, self.generator, self.max_gaussians)
            self._restart()


@torch.no_grad()
def densify(p: Parameters, grad_accum: Tensor, generator: torch.Generator, max_gaussians: int) -> None:
    """Removes the faint and the lost, and splits the SHARE of the rest with the largest accumulated gradients
    (grad_accum (N,)) in two: smaller, and apart by a random step within the Gaussian, so that both together look
    about as it did; never more than `max_gaussians` in all."""
    keep = (torch.sigmoid(p["opacity"]) > FAINT) & (p["xyz"].abs().amax(-1) < OUTSIDE)
    kept = keep.nonzero()[:, 0]
    n = len(kept)
    count = max(min(int(SHARE * n), max_gaussians - n), 0)
    split = grad_accum[kept].topk(count).indices
    p.keep_rows(torch.cat([kept, kept[split]]))
    both = torch.cat([split, torch.arange(n, n + count, device=split.device)])
    g = activate(p.values)[split]
    step = torch.randn(count, 3, generator=generator).to(g.scale) * g.scale
    step = (rotation_matrix(g.rotation) @ step[..., None])[..., 0]
    p["xyz"][both] += torch.cat([step, -step])
    p["scale"][both] -= torch.tensor(SHRINK).log()
    p.reset_moments(both)
