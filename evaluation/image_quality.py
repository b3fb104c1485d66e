# SPDX-License-Identifier: GPL-3.0-or-later
"""How close pictures are: PSNR, foreground PSNR, SSIM. Images (…,H,W,3), values 0..1.

Perceptual measures have files of their own, `flip` and `lpips`. Pictures of objects are mostly empty: what
looks at a neighbourhood is computed where something is shown, and known without computing elsewhere.
"""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

WINDOW = 11  # pixels a side of SSIM's window
STEP = 16  # crops grow to multiples of this, so that few filter matrices are needed


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
    the pixels whose window lies inside; colour channels averaged. Images of 11 pixels a side or more.

    Where both are white the index is 1: windows that reach nothing else are counted, not computed."""
    height, width = image.shape[-3:-1]
    windows = (height - WINDOW + 1) * (width - WINDOW + 1)
    scores = []
    for x, y in zip(image.reshape(-1, height, width, 3), target.reshape(-1, height, width, 3), strict=True):
        rows, columns = shown(x, y, WINDOW - 1)
        if rows.stop == 0:
            scores.append(x.new_ones(()))
            continue
        inside = _ssim(x[rows, columns].clamp(0, 1).movedim(-1, 0), y[rows, columns].clamp(0, 1).movedim(-1, 0))
        scores.append(1 - (1 - inside).sum((-2, -1)).mean() / windows)
    return torch.stack(scores).reshape(image.shape[:-3])


def _ssim(x: Tensor, y: Tensor) -> Tensor:
    """x, y (C,H,W) -> (C,H-10,W-10) the index of each window."""
    height, width = x.shape[-2:]
    w = torch.exp(-0.5 * ((torch.arange(WINDOW, dtype=torch.float64) - WINDOW // 2) / 1.5) ** 2)
    kernel = tuple((w / w.sum()).tolist())
    maps = torch.stack([x, y, x * x, y * y, x * y])
    maps = valid(kernel, height).to(x) @ maps @ valid(kernel, width).to(x).T
    mx, my, xx, yy, xy = maps
    vx, vy, cov = xx - mx * mx, yy - my * my, xy - mx * my
    c1, c2 = 0.01**2, 0.03**2
    return (2 * mx * my + c1) * (2 * cov + c2) / ((mx * mx + my * my + c1) * (vx + vy + c2))


@lru_cache(maxsize=64)
def valid(kernel: tuple[float, ...], size: int) -> Tensor:
    """(size - taps + 1, size) float64: correlation with a kernel as a matrix, where the kernel lies inside. One
    product with it is faster than torch's convolution of single channels."""
    out = torch.zeros(size - len(kernel) + 1, size, dtype=torch.float64)
    for i, k in enumerate(kernel):
        out.diagonal(i).fill_(k)
    return out


def shown(x: Tensor, y: Tensor, margin: int) -> tuple[slice, slice]:
    """Rows and columns of the box around all pixels of two pictures (H,W,3) where either is not white, `margin`
    pixels wider on every side, as far as there are any; its sides are multiples of STEP or the whole picture.
    Empty slices where both are white."""
    ink = (x < 1).any(-1) | (y < 1).any(-1)
    return _span(ink.any(1), margin), _span(ink.any(0), margin)


def _span(ink: Tensor, margin: int) -> slice:
    where = ink.nonzero()
    if not len(where):
        return slice(0, 0)
    first, last = max(int(where[0]) - margin, 0), min(int(where[-1]) + 1 + margin, len(ink))
    length = min(-(-(last - first) // STEP) * STEP, len(ink))
    first = min(first, len(ink) - length)
    return slice(first, first + length)
