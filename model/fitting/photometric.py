# SPDX-License-Identifier: GPL-3.0-or-later
"""How far drawn pictures are from those to be matched: mean absolute error of colour and alpha, and structural
similarity (SSIM, Wang et al. 2004; a share of it is 3DGS's loss). One compiled pass with the gradient: in torch's
single operations it takes longer than drawing the pictures."""

from __future__ import annotations

import numba
import numpy as np
import torch
from torch import Tensor

from ..parallel import parallel_for
from ..views import Views

ALPHA_WEIGHT = 0.3  # of the error in alpha against that in colour
RADIUS = 5  # pixels of the window of SSIM …
_offsets = np.arange(-RADIUS, RADIUS + 1)
WINDOW = (lambda w: (w / w.sum()).astype(np.float32))(np.exp(-0.5 * (_offsets / 1.5) ** 2))  # … of σ 1.5 pixels
C1, C2 = np.float32(0.01**2), np.float32(0.03**2)


def photometric_error(rgb: Tensor, alpha: Tensor, views: Views, background: Tensor, ssim_weight: float = 0.0) -> Tensor:
    """() of rgb (B,H,W,3), drawn over `background` (3,), and alpha (B,H,W) against the B views: the mean absolute
    error of colour, of which SSIM takes the place by `ssim_weight` (0..1) as 1 - SSIM, and ALPHA_WEIGHT times that of
    alpha. Outside of a picture both are black to SSIM."""
    if rgb.device.type != "cpu" or rgb.dtype != torch.float32:
        return _by_torch(rgb, alpha, views, background, ssim_weight)
    return _Photometric.apply(rgb, alpha, views.rgb, views.alpha, background, ssim_weight)


def _by_torch(rgb: Tensor, alpha: Tensor, views: Views, background: Tensor, ssim_weight: float) -> Tensor:
    target = views.over(background)
    error = (1 - ssim_weight) * (rgb - target).abs().mean() + ALPHA_WEIGHT * (alpha - views.alpha).abs().mean()
    return error + ssim_weight * (1 - _ssim_by_torch(rgb, target)) if ssim_weight else error


def _ssim_by_torch(x: Tensor, y: Tensor) -> Tensor:
    """() mean of SSIM of pictures (B,H,W,3)."""
    window = torch.as_tensor(WINDOW, dtype=x.dtype, device=x.device)

    def blur(z: Tensor) -> Tensor:  # (B,H,W,3)
        z = z.movedim(-1, 1).reshape(-1, 1, *z.shape[1:3])
        z = torch.nn.functional.conv2d(z, window.view(1, 1, -1, 1), padding=(RADIUS, 0))
        return torch.nn.functional.conv2d(z, window.view(1, 1, 1, -1), padding=(0, RADIUS))

    mx, my, xx, yy, xy = map(blur, (x, y, x * x, y * y, x * y))
    like = (2 * mx * my + C1) * (2 * (xy - mx * my) + C2)
    return (like / ((mx * mx + my * my + C1) * (xx - mx * mx + yy - my * my + C2))).mean()


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(ctx, rgb, alpha, true_rgb, true_alpha, background, ssim_weight):
        arrays = [x.detach().contiguous().numpy() for x in (rgb, alpha, true_rgb, true_alpha, background)]
        g_rgb, g_alpha = np.empty(rgb.shape, np.float32), np.empty(alpha.shape, np.float32)
        target = np.empty(rgb.shape, np.float32)
        count, height = len(rgb), rgb.shape[1]
        bands = [(b, y, min(y + 32, height)) for b in range(count) for y in range(0, height, 32)]
        weight = np.float32(1 - ssim_weight)
        sums = parallel_for(bands, lambda b, y, e: _absolute(b, y, e, *arrays, weight, g_rgb, g_alpha, target))
        value = sum(total for total, *_ in sums)
        if ssim_weight:
            scale, around = np.float32(ssim_weight / rgb.numel()), 2 * RADIUS

            def similarity(b, c):
                # Further from what is shown than a window's width both are background: SSIM is 1 there, its gradient 0.
                there = [s for s, (of, *_) in zip(sums, bands, strict=True) if of == b]
                rows = slice(max(min(s[1] for s in there) - around, 0), max(s[2] for s in there) + around + 1)
                columns = slice(max(min(s[3] for s in there) - around, 0), max(s[4] for s in there) + around + 1)
                x, y, g = (v[b, rows, columns, c] for v in (arrays[0], target, g_rgb))
                return (x.size - _similarity(x, y, scale, g)) if x.size else 0.0

            unlike = parallel_for([(b, c) for b in range(count) for c in range(3)], similarity)
            value += float(scale) * sum(unlike)
        ctx.gradients = torch.from_numpy(g_rgb), torch.from_numpy(g_alpha)
        return rgb.new_tensor(value)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, g: Tensor):
        return *(g * x for x in ctx.gradients), None, None, None, None


@numba.njit(cache=True, nogil=True, fastmath=True)
def _absolute(b, first, end, rgb, alpha, true_rgb, true_alpha, background, weight, g_rgb, g_alpha, target):
    """Rows first..end of picture b: -> the part of the error, and the first and last row and column where either
    picture shows something; writes gradients, and the picture to be matched."""
    colour, cover = weight / np.float32(rgb.size), np.float32(ALPHA_WEIGHT / alpha.size)
    total, top, bottom, left, right = 0.0, rgb.shape[1], -1, rgb.shape[2], -1
    for y in range(first, end):
        for x in range(rgb.shape[2]):
            a = true_alpha[b, y, x]
            if a > 0 or alpha[b, y, x] > 0:
                top, bottom, left, right = min(top, y), max(bottom, y), min(left, x), max(right, x)
            for c in range(3):
                t = true_rgb[b, y, x, c] * a + background[c] * (1 - a)
                target[b, y, x, c] = t
                e = rgb[b, y, x, c] - t
                total += colour * abs(e)
                g_rgb[b, y, x, c] = colour if e > 0 else -colour if e < 0 else np.float32(0)
            e = alpha[b, y, x] - a
            total += cover * abs(e)
            g_alpha[b, y, x] = cover if e > 0 else -cover if e < 0 else np.float32(0)
    return total, top, bottom, left, right


@numba.njit(cache=True, nogil=True, fastmath=True)
def _blur(source, down, out):
    """The window's mean of source (H,W) -> out, as if 0 lay around it; `down` is room for what is between."""
    height, width = source.shape
    for y in range(height):
        row = down[y]
        row[:] = 0
        for k in range(max(-RADIUS, -y), min(RADIUS + 1, height - y)):
            w, other = WINDOW[k + RADIUS], source[y + k]
            for x in range(width):
                row[x] += w * other[x]
    for y in range(height):
        row, into = down[y], out[y]
        into[:] = 0
        for k in range(-RADIUS, RADIUS + 1):
            w, first, count = WINDOW[k + RADIUS], max(0, -k), max(width - abs(k), 0)
            to, of = into[first : first + count], row[first + k : first + k + count]
            for x in range(count):  # no index that could be below 0: so it is done by vectors
                to[x] += w * of[x]


@numba.njit(cache=True, nogil=True, fastmath=True)
def _similarity(image, true, scale, g_image):
    """One channel of a picture and of the one to be matched, (H,W) views -> the sum of SSIM; takes `scale` times its
    gradient from g_image (H,W)."""
    height, width = image.shape
    x, y = np.ascontiguousarray(image), np.ascontiguousarray(true)
    down = np.empty((height, width), np.float32)
    mx, my, s = np.empty_like(x), np.empty_like(x), np.empty_like(x)
    xx, xy = np.empty_like(x), np.empty_like(x)
    _blur(x, down, mx)
    _blur(y, down, my)
    _blur(x * x + y * y, down, xx)
    _blur(x * y, down, xy)
    total = 0.0
    for i in range(height):
        for j in range(width):
            p, q = mx[i, j], my[i, j]
            a1, a2 = 2 * p * q + C1, 2 * (xy[i, j] - p * q) + C2
            b1 = p * p + q * q + C1
            b2 = xx[i, j] - p * p - q * q + C2
            one = 1 / (b1 * b2)
            value = a1 * a2 * one
            total += value
            # d SSIM / d mean of x, of x² and of x y
            mx[i, j] = 2 * (q * (a2 - a1) * one - p * value * (1 / b1 - 1 / b2))
            xx[i, j] = -value / b2
            xy[i, j] = 2 * a1 * one
    _blur(mx, down, s)
    _blur(xx, down, mx)
    _blur(xy, down, my)
    for i in range(height):
        for j in range(width):
            g_image[i, j] -= scale * (s[i, j] + 2 * x[i, j] * mx[i, j] + y[i, j] * my[i, j])
    return total
