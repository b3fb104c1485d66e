# SPDX-License-Identifier: GPL-3.0-or-later
"""How close pictures are: PSNR, foreground PSNR, SSIM. Images (…,H,W,3), values 0..1."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def psnr(image: Tensor, target: Tensor) -> Tensor:
    """(…) dB per image, on [0,1]; predictions are clamped to it, as an 8-bit file would be."""
    mse = (image.clamp(0, 1) - target).square().mean((-3, -2, -1))
    return -10 * torch.log10(mse.clamp_min(1e-10))


def psnr_foreground(image: Tensor, target: Tensor, alpha: Tensor, target_alpha: Tensor) -> Tensor:
    """(…) dB over the pixels (…,H,W) where either picture shows the object (alpha above 1/255): a white
    background flatters nobody here, and stray Gaussians outside of the object count."""
    mask = (torch.maximum(alpha, target_alpha) > 1 / 255).float()
    error = (image.clamp(0, 1) - target).square().mean(-1) * mask
    mse = error.sum((-2, -1)) / mask.sum((-2, -1)).clamp_min(1)
    return -10 * torch.log10(mse.clamp_min(1e-10))


def ssim(image: Tensor, target: Tensor) -> Tensor:
    """(…) structural similarity: Gaussian window of 11 pixels, σ 1.5, data range 1 (Wang et al. 2004), over
    the pixels whose window lies inside; colour channels averaged."""
    batch = image.shape[:-3]
    x, y = (z.clamp(0, 1).reshape(-1, *z.shape[-3:]).movedim(-1, 1).flatten(0, 1)[:, None] for z in (image, target))
    r = torch.arange(11, device=x.device, dtype=x.dtype) - 5
    w = torch.exp(-0.5 * (r / 1.5) ** 2)
    w = w / w.sum()

    def blur(z: Tensor) -> Tensor:
        return F.conv2d(F.conv2d(z, w[None, None, None]), w[None, None, :, None])

    mx, my = blur(x), blur(y)
    vx, vy, cov = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    c1, c2 = 0.01**2, 0.03**2
    s = (2 * mx * my + c1) * (2 * cov + c2) / ((mx * mx + my * my + c1) * (vx + vy + c2))
    return s.mean((-3, -2, -1)).reshape(*batch, 3).mean(-1)
