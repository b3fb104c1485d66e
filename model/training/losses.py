# SPDX-License-Identifier: GPL-3.0-or-later
"""What training minimises: mean squared error + 0.5 · perceptual loss (paper, 2.3), and terms of our own."""

from __future__ import annotations

import sys

import torch
from torch import Tensor, nn

from ..gaussians import Gaussians4D
from ..views import Views
from .vgg import STD, VGG, find_weights

# Chen & Koltun 2017 and their successors up to GS-LRM's lineage: layers of VGG-19 and the weight of each.
LAYERS = {"relu1_2": 1 / 2.6, "relu2_2": 1 / 4.8, "relu3_2": 1 / 3.7, "relu4_2": 1 / 5.6, "relu5_2": 10 / 1.5}


def photometric(rgb: Tensor, alpha: Tensor, targets: Views, background: Tensor) -> Tensor:
    """Mean squared error of pictures rgb (C,H,W,3), both composited over `background` (3,), plus that of
    alpha (C,H,W): what is white must not be mistaken for nothing."""
    return (rgb - targets.over(background)).square().mean() + 0.3 * (alpha - targets.alpha).square().mean()


class Perceptual(nn.Module):
    """Mean absolute difference of the pictures and of their VGG-19 features (average pooling), weighted by LAYERS.

    Those weights were found for features of pictures in 0..255 and a sum divided by 255. Ours see pictures divided
    by STD, so that features count times its mean, which is the same in units of the picture."""

    def __init__(self, network: VGG):
        super().__init__()
        self.network = network

    def forward(self, rgb: Tensor, wanted: Tensor) -> Tensor:
        """rgb, wanted (C,H,W,3) in 0..1 over the same background -> scalar, differentiable in rgb."""
        total = (rgb - wanted).abs().mean()
        mine = self.network(rgb.permute(0, 3, 1, 2), list(LAYERS))
        with torch.no_grad():
            other = self.network(wanted.permute(0, 3, 1, 2), list(LAYERS))
        for a, b, weight in zip(mine, other, LAYERS.values(), strict=True):
            total = total + weight * (sum(STD) / 3) * (a - b).abs().mean()
        return total


def load_perceptual() -> Perceptual | None:
    """With the VGG-19 weights of this machine; None, and a line that says so, where there are none."""
    path = find_weights("vgg19")
    if path is None:
        print(
            "train: no perceptual loss, for there are no VGG-19 weights; put torchvision's vgg19-dcbb9e9d.pth into a "
            "folder and name that in TIMESPLAT_WEIGHTS.",
            file=sys.stderr,
        )
        return None
    return Perceptual(VGG(19, pool="average").load(path))


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
