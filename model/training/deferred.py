# SPDX-License-Identifier: GPL-3.0-or-later
"""Deferred backpropagation through the rasteriser (Zhang et al. 2022; paper, appendix A.2).

The loss is a mean over target views. So the views are drawn a few at a time, and the gradient of each few is taken
to the Gaussians alone, which are cut off from the network; one backward pass through the network follows. What the
rasteriser keeps is that of a few views, and no view is drawn twice.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from ..gaussians import Gaussians4D
from ..rasterize import render
from ..views import Views

CHUNK = 4  # views drawn at a time


class Cut:
    """A scene (with a `map` over its tensors, as Gaussians4D has) whose gradients stop at its tensors."""

    def __init__(self, scene):
        if isinstance(scene, Gaussians4D):  # the covariance is computed once, not once for every few views
            scene = replace(scene, cov3=scene.covariance3())
        self.sources: list[Tensor] = []
        self.leaves: list[Tensor] = []
        self.scene = scene.map(self._cut)

    def _cut(self, x: Tensor) -> Tensor:
        self.sources.append(x)
        self.leaves.append(x.detach().requires_grad_(x.requires_grad))
        return self.leaves[-1]

    def finite(self) -> bool:
        return all(torch.isfinite(x).all() for x in self.leaves)

    def views_loss(
        self, targets: Views, background: Tensor, loss: Callable[[Tensor, Tensor, Views], Tensor], chunk: int = CHUNK
    ) -> tuple[float, float]:
        """Adds the gradients of the mean loss over the target views to the leaves. loss(rgb, alpha, views) is the
        mean over a few views. Returns it over all, and the mean PSNR of the views over the background (3,)."""
        total, psnr, height, width = 0.0, 0.0, *targets.size
        for i in range(0, len(targets), chunk):
            few = targets[i : i + chunk]
            rgb, alpha = render(self.scene, few.c2w, few.intrinsics, few.time, width, height, background=background)
            part = loss(rgb, alpha, few) * (len(few) / len(targets))
            part.backward()
            total += float(part.detach())
            with torch.no_grad():
                mse = (rgb - few.over(background)).square().mean((1, 2, 3)).clamp_min(1e-10)
                psnr += float((-10 * torch.log10(mse)).sum()) / len(targets)
        return total, psnr

    def backward(self, weight: float = 1.0, more: Tensor | None = None) -> None:
        """Takes `weight` times the gradients of the leaves, and those of the scalar `more`, on into the network."""
        pairs = [(s, weight * x.grad) for s, x in zip(self.sources, self.leaves, strict=True) if x.grad is not None]
        if more is not None:
            pairs.append((weight * more, None))
        if pairs:
            tensors, gradients = zip(*pairs, strict=True)
            torch.autograd.backward(tensors, gradients)
