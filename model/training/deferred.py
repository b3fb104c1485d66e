# SPDX-License-Identifier: GPL-3.0-or-later
"""Deferred backpropagation through the rasteriser (Zhang et al. 2022; paper, appendix A.2)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from ..gaussians import DynamicScene, Gaussians4D
from ..rasterize import render
from ..views import Views

VIEWS_AT_A_TIME = 4


class DetachedScene:
    """A scene on whose tensors gradients are gathered before one backward pass takes them on into the network.

    The loss is a mean over target views. So the views are drawn a few at a time, and the gradient of each few is taken
    to the scene alone, which is detached from the network: what the rasteriser keeps is that of a few views, and no
    view is drawn twice."""

    def __init__(self, scene: DynamicScene):
        """scene: Gaussians4D, or another with a `map` over its tensors."""
        if isinstance(scene, Gaussians4D):  # the covariance is computed once, not once for every few views
            scene = replace(scene, cov3=scene.covariance3())
        self.attached: list[Tensor] = []  # the scene's tensors, of any shapes, as the network made them
        self.leaves: list[Tensor] = []  # the same, where gradients stop
        self.scene = scene.map(self._detach)

    def _detach(self, x: Tensor) -> Tensor:
        self.attached.append(x)
        self.leaves.append(x.detach().requires_grad_(x.requires_grad))
        return self.leaves[-1]

    def is_finite(self) -> bool:
        return all(torch.isfinite(x).all() for x in self.leaves)

    def backward_views(
        self,
        targets: Views,
        background: Tensor,
        loss: Callable[[Tensor, Tensor, Views], Tensor],
        chunk: int = VIEWS_AT_A_TIME,
    ) -> tuple[float, float]:
        """Adds the gradients of the mean loss over the target views (V) to the leaves; `chunk` views are drawn at a
        time, over the background (3,). loss(rgb (C,H,W,3), alpha (C,H,W), views (C)) -> scalar, their mean. Returns it
        over all, and the mean PSNR of the views in dB."""
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

    def backward_network(self, weight: float = 1.0, scene_loss: Tensor | None = None) -> None:
        """Takes `weight` times the gradients of the leaves, and those of the scalar `scene_loss` on the attached
        scene, on into the network."""
        pairs = [(x, weight * y.grad) for x, y in zip(self.attached, self.leaves, strict=True) if y.grad is not None]
        if scene_loss is not None:
            pairs.append((weight * scene_loss, None))
        if pairs:
            tensors, gradients = zip(*pairs, strict=True)
            torch.autograd.backward(tensors, gradients)
