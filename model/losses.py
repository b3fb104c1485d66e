# SPDX-License-Identifier: GPL-3.0-or-later
"""What training minimises."""

from __future__ import annotations

import torch
from torch import Tensor

from .gaussians import Gaussians4D
from .views import Views


def photometric(rgb: Tensor, alpha: Tensor, targets: Views, background: Tensor) -> Tensor:
    """Mean squared error of pictures rgb (C,H,W,3), both composited over `background` (3,), plus that of
    alpha (C,H,W): what is white must not be mistaken for nothing."""
    return (rgb - targets.over(background)).square().mean() + 0.3 * (alpha - targets.alpha).square().mean()


def geometric(g: Gaussians4D, view_time: Tensor, truth: Gaussians4D, known: Tensor) -> Tensor:
    """For networks that see RGB alone: mean distance of pixel-aligned Gaussians (N,) at the time (N,) of
    their view from where the lift of the renderer's depth (`truth`, N, valid where `known`) has them, and of
    their velocities. Huber, so that silhouettes do not rule."""
    if not known.any():
        return g.xyz.sum() * 0
    place = (g.position(view_time) - truth.position(view_time))[known]
    speed = (g.velocity - truth.velocity)[known]
    return _huber(place, 0.05) + 0.05 * _huber(speed, 0.3)


def _huber(x: Tensor, delta: float) -> Tensor:
    return torch.nn.functional.huber_loss(x, torch.zeros_like(x), delta=delta) / delta
