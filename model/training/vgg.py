# SPDX-License-Identifier: GPL-3.0-or-later
"""Features of VGG-16 and VGG-19 (Simonyan & Zisserman 2014) for perceptual losses and metrics."""

from __future__ import annotations

import os
from pathlib import Path

import torch
from torch import Tensor, nn

from ...datagen.sequence import InputError

CONVOLUTIONS = {16: (2, 2, 3, 3, 3), 19: (2, 2, 4, 4, 4)}  # by block; a pooling ends each
CHANNELS = (64, 128, 256, 512, 512)
IMAGENET_MEAN, IMAGENET_STD = (
    (0.485, 0.456, 0.406),
    (0.229, 0.224, 0.225),
)  # of the pictures that the weights were trained on


class VGG(nn.Module):
    """The convolutions of VGG-`depth` (16 or 19) without gradients of their own, in evaluation mode. The layers are in
    the order of torchvision's `features`, so that its weight files fit. pool: "max" as trained, or "average" as
    perceptual losses have it (smoother gradients)."""

    def __init__(self, depth: int, pool: str = "max"):
        super().__init__()
        self.names: list[str] = []  # conv1_1 relu1_1 conv1_2 … pool5; the place in it is torchvision's index
        layers: list[nn.Module] = []
        before = 3
        for block, (count, width) in enumerate(zip(CONVOLUTIONS[depth], CHANNELS, strict=True), 1):
            for i in range(1, count + 1):
                self.names += [f"conv{block}_{i}", f"relu{block}_{i}"]
                layers += [nn.Conv2d(before, width, 3, padding=1), nn.ReLU()]
                before = width
            self.names.append(f"pool{block}")
            layers.append(nn.MaxPool2d(2) if pool == "max" else nn.AvgPool2d(2))
        self.features = nn.Sequential(*layers)
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN)[:, None, None], persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD)[:, None, None], persistent=False)
        self.eval().requires_grad_(False)

    def forward(self, x: Tensor, layers: list[str]) -> list[Tensor]:
        """x (N,3,H,W) sRGB in 0..1, at least 16 pixels each way for the fifth block -> for each of `layers`, in
        the order of the network, its output (N,C,h,w). Differentiable in x; nothing deeper is computed."""
        wanted, out = {self.names.index(name) for name in layers}, []
        x = (x - self.mean) / self.std
        for i in range(max(wanted) + 1):
            x = self.features[i](x)
            if i in wanted:
                out.append(x)
        return out

    def load(self, path: Path) -> VGG:
        """Reads torchvision's weights (a state dict with `features.N.weight` and `.bias`; the classifier is left
        out) and returns the network. Raises InputError for a file that is missing, damaged or another's."""
        try:
            state = torch.load(path, map_location="cpu", weights_only=True)
            state = {k: v.float() for k, v in state.items() if k.startswith("features.")}
            self.load_state_dict(state)
        except Exception as e:
            reason = (str(e).splitlines() or [type(e).__name__])[0]
            raise InputError(f"{path}: not the VGG weights of torchvision ({reason}); copy the file again.") from None
        if not all(torch.isfinite(v).all() for v in state.values()):
            raise InputError(f"{path}: the weights hold NaN or infinity; copy the file again.")
        return self


def find_weights(name: str) -> Path | None:
    """The file `NAME.pth` or `NAME-*.pth` ("vgg16" finds vgg16-397923af.pth, not vgg16_bn-….pth) in the folder
    $TIMESPLAT_WEIGHTS, else in torch's hub cache; None where neither has one. None is fetched."""
    folders = [Path(torch.hub.get_dir()) / "checkpoints"]
    if os.environ.get("TIMESPLAT_WEIGHTS"):
        folders.insert(0, Path(os.environ["TIMESPLAT_WEIGHTS"]))
    for folder in folders:
        for pattern in (f"{name}.pth", f"{name}-*.pth"):
            if found := sorted(folder.glob(pattern)):
                return found[0]
    return None
