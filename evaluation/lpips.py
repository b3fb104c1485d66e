# SPDX-License-Identifier: GPL-3.0-or-later
"""LPIPS, the VGG variant 0.1 (Zhang et al., CVPR 2018): how far apart two pictures are in the features of VGG-16.

Two weight files, which are not part of this project: torchvision's `vgg16-397923af.pth` and the authors' linear
layers, `vgg.pth` of their package (lpips/weights/v0.1), named `lpips_vgg.pth`. See `vgg` for where they are found.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import torch
from torch import Tensor

from ..datagen.sequence import InputError
from ..model.training.vgg import VGG, find_weights

LAYERS = ["relu1_2", "relu2_2", "relu3_3", "relu4_3", "relu5_3"]
CHANNELS = (64, 128, 256, 512, 512)
HINT = (
    "LPIPS is left out (–). To have it, put torchvision's vgg16-397923af.pth, and the lpips package's "
    "weights/v0.1/vgg.pth as lpips_vgg.pth, into a folder and name it in $TIMESPLAT_WEIGHTS."
)


class LPIPS:
    """The distance with weights loaded; see `find_lpips`."""

    def __init__(self, vgg: VGG, weights: list[Tensor]):
        """weights: for each of LAYERS (C,), not negative."""
        self.vgg, self.weights = vgg, weights

    def __call__(self, image: Tensor, target: Tensor) -> Tensor:
        """image, target (V,H,W,3) sRGB, clamped to 0..1, 16 pixels a side or more -> (V,) distances."""
        with torch.no_grad():
            return torch.stack([self._one(x, y) for x, y in zip(image, target, strict=True)])

    def _one(self, x: Tensor, y: Tensor) -> Tensor:
        # VGG's own normalisation is that of LPIPS: its shift and scale are ImageNet's mean and deviation for -1..1.
        maps = self.vgg(torch.stack([x, y]).clamp(0, 1).movedim(-1, 1), LAYERS)
        total = x.new_zeros(())
        for w, f in zip(self.weights, maps, strict=True):
            unit = f / (f.square().sum(1, keepdim=True).sqrt() + 1e-10)
            total = total + ((unit[0] - unit[1]).square() * w[:, None, None]).sum(0).mean()
        return total


def find_lpips() -> LPIPS | None:
    """LPIPS from the files of `find_weights`, loaded once; None where one is missing. Raises InputError for a damaged
    one."""
    features, linear = find_weights("vgg16"), find_weights("lpips_vgg")
    return _load(features, linear) if features and linear else None


@lru_cache(maxsize=1)
def _load(features: Path, linear: Path) -> LPIPS:
    return LPIPS(VGG(16).load(features), load_linear(linear))


def load_linear(path: Path) -> list[Tensor]:
    """The weight of every channel of LAYERS, from `linN.model.1.weight` (1,C,1,1). Raises InputError."""
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        weights = [state[f"lin{i}.model.1.weight"].float().flatten() for i in range(len(LAYERS))]
    except Exception as e:
        reason = (str(e).splitlines() or [type(e).__name__])[0]
        raise InputError(f"{path}: not the linear weights of LPIPS ({reason}); copy the file again.") from None
    if any(w.shape != (c,) or not (w.isfinite() & (w >= 0)).all() for w, c in zip(weights, CHANNELS, strict=True)):
        raise InputError(f"{path}: the weights of LPIPS have wrong sizes or values; copy the file again.")
    return weights
