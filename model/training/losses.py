# SPDX-License-Identifier: GPL-3.0-or-later
"""What training minimises: mean squared error + 0.5 · perceptual loss (paper, 2.3), and terms of our own."""

from __future__ import annotations

import sys
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ..gaussians import Gaussians4D
from ..geometry.features import Geometry
from ..geometry.lift import lift_geometry
from ..network import Network
from ..views import Views
from .vgg import IMAGENET_STD, VGG, find_weights

# Chen & Koltun 2017 and their successors up to GS-LRM's lineage: layers of VGG-19 and the weight of each.
PERCEPTUAL_LAYERS = {
    "relu1_2": 1 / 2.6,
    "relu2_2": 1 / 4.8,
    "relu3_2": 1 / 3.7,
    "relu4_2": 1 / 5.6,
    "relu5_2": 10 / 1.5,
}
ALPHA_WEIGHT = 0.3  # of alpha's squared error beside that of the colours


@dataclass(frozen=True)
class GeometricScales:
    """Where the geometric loss turns from squared to absolute, in normalised units, and how velocity counts."""

    position: float = 0.05
    velocity: float = 0.3  # a unit of time
    velocity_weight: float = 0.05


GEOMETRIC_SCALES = GeometricScales()


def photometric_loss(rgb: Tensor, alpha: Tensor, targets: Views, background: Tensor) -> Tensor:
    """Mean squared error of pictures rgb (C,H,W,3), both composited over `background` (3,), plus that of
    alpha (C,H,W): what is white must not be mistaken for nothing. targets: the C views."""
    return (rgb - targets.over(background)).square().mean() + ALPHA_WEIGHT * (alpha - targets.alpha).square().mean()


class PerceptualLoss(nn.Module):
    """Mean absolute difference of the pictures and of their VGG-19 features (average pooling), weighted by
    PERCEPTUAL_LAYERS.

    Those weights were found for features of pictures in 0..255 and a sum divided by 255. Ours see pictures divided
    by IMAGENET_STD, so that features count times its mean, which is the same in units of the picture."""

    def __init__(self, network: VGG):
        super().__init__()
        self.network = network

    def forward(self, rgb: Tensor, wanted: Tensor) -> Tensor:
        """rgb, wanted (C,H,W,3) in 0..1 over the same background -> scalar, differentiable in rgb."""
        total = (rgb - wanted).abs().mean()
        mine = self.network(rgb.permute(0, 3, 1, 2), list(PERCEPTUAL_LAYERS))
        with torch.no_grad():
            other = self.network(wanted.permute(0, 3, 1, 2), list(PERCEPTUAL_LAYERS))
        for a, b, weight in zip(mine, other, PERCEPTUAL_LAYERS.values(), strict=True):
            total = total + weight * (sum(IMAGENET_STD) / 3) * (a - b).abs().mean()
        return total


def load_perceptual_loss() -> PerceptualLoss | None:
    """With the VGG-19 weights of this machine; None, and a line that says so, where there are none. Raises
    InputError for a damaged file."""
    path = find_weights("vgg19")
    if path is None:
        print(
            "train: no perceptual loss, for there are no VGG-19 weights; put torchvision's vgg19-dcbb9e9d.pth into a "
            "folder and name that in TIMESPLAT_WEIGHTS.",
            file=sys.stderr,
        )
        return None
    return PerceptualLoss(VGG(19, pool="average").load(path))


@dataclass
class PixelTruth:
    """What the lift of the renderer's depth says of the pixels of N of a network's Gaussians."""

    gaussians: Gaussians4D  # (N,)
    view_time: Tensor  # (N,) -1..1, of the view that the pixel is of
    known: Tensor  # (N,) bool: whether there is depth; the Gaussians of others are arbitrary

    def __len__(self) -> int:
        return len(self.known)

    def to(self, device: str) -> PixelTruth:
        return PixelTruth(self.gaussians.to(device), self.view_time.to(device), self.known.to(device))


def pixel_truth(network: Network, inputs: Views, geometry: Geometry | None) -> PixelTruth:
    """For each of the Gaussians that the network makes of pixels, in their order. inputs: V views with depth and flow;
    geometry: what the network starts from, if anything."""
    lifted = lift_geometry(inputs)
    if geometry is not None:
        owner = geometry.pixel_index
    else:
        place = network.pixel_places(inputs, network.kept_patches(inputs))
        kept = (place >= 0).nonzero()[:, 0]
        owner = kept[torch.argsort(place[kept])]
    view_time = inputs.time[:, None, None].expand_as(inputs.alpha).flatten()
    away = (lifted.gaussians.t - view_time[lifted.pixel_index]).abs()
    order = torch.argsort(away, descending=True, stable=True)
    piece = torch.full((len(view_time),), -1)
    piece.numpy()[lifted.pixel_index[order].numpy()] = order.numpy()  # of a pixel's pieces the one of its own time
    return PixelTruth(lifted.gaussians[piece[owner]], view_time[owner], piece[owner] >= 0)


def geometric_loss(g: Gaussians4D, truth: PixelTruth) -> Tensor:
    """For networks that see RGB alone: mean distance of pixel-aligned Gaussians (N,), at the time of their view, from
    where the truth (N) has them, and of their velocities. Huber, so that silhouettes do not rule."""
    if not truth.known.any():
        return g.xyz.sum() * 0
    away = (g.position(truth.view_time) - truth.gaussians.position(truth.view_time))[truth.known]
    faster = (g.velocity - truth.gaussians.velocity)[truth.known]
    scales = GEOMETRIC_SCALES
    return _huber(away, scales.position) + scales.velocity_weight * _huber(faster, scales.velocity)


def _huber(x: Tensor, delta: float) -> Tensor:
    """x (…) -> scalar: the mean of |x| beyond delta, and of x² / 2 delta, joined to it, within."""
    return torch.nn.functional.huber_loss(x, torch.zeros_like(x), delta=delta) / delta
