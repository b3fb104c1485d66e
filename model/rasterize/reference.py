# SPDX-License-Identifier: GPL-3.0-or-later
"""What the rasteriser computes, as plain torch: every pixel against every Gaussian in depth order, autograd.

Memory and time grow with N · width · height: for tests and for reading. In float64 it is the yardstick."""

from __future__ import annotations

import torch
from torch import Tensor

from ..gaussians import Gaussians4D
from .constants import ALPHA_MAX, ALPHA_MIN, BLUR, INFERENCE_MIN, NEAR_PLANE, SLOPE_MARGIN, TRANSMITTANCE_MIN
from .inputs import Cameras, RenderOptions, check_finite


def project(
    mean: Tensor, covariance: Tensor, c2w: Tensor, intrinsics: Tensor, width: int, height: int
) -> tuple[Tensor, Tensor]:
    """mean (K,3), covariance (K,3,3), c2w (4,4), intrinsics (4) -> pixel means (K,2) and 2D covariances (K,2,2) in px²
    by EWA splatting: Σ₂ = J W Σ Wᵀ Jᵀ + 0.3 I with the Jacobian J of the perspective division taken at slopes clamped
    to the field of view widened by 30 % of its half tangent, as gsplat does."""
    W = c2w[:3, :3].T
    x, y, z = ((mean - c2w[:3, 3]) @ W.T).unbind(-1)
    fx, fy, cx, cy = intrinsics
    z = torch.where(z >= NEAR_PLANE, z, torch.ones_like(z))  # those behind are dropped by the caller; no NaN from here
    mx, my = SLOPE_MARGIN * 0.5 * width / fx, SLOPE_MARGIN * 0.5 * height / fy
    sx = torch.clamp(x / z, -cx / fx - mx, (width - cx) / fx + mx)
    sy = torch.clamp(y / z, -cy / fy - my, (height - cy) / fy + my)
    zero = torch.zeros_like(z)
    J = torch.stack([fx / z, zero, -fx * sx / z, zero, fy / z, -fy * sy / z], -1).unflatten(-1, (2, 3))
    M = J @ W
    symmetric = 0.5 * (covariance + covariance.mT)
    cov2 = M @ symmetric @ M.mT + BLUR * torch.eye(2, dtype=mean.dtype)
    return torch.stack([fx * x / z + cx, fy * y / z + cy], -1), cov2


def rasterize(gaussians: Gaussians4D, cameras: Cameras, options: RenderOptions) -> tuple[Tensor, Tensor]:
    """-> rgb (C,height,width,3), alpha (C,height,width); see `render`. ValueError for NaN or infinity."""
    check_finite(gaussians, cameras)
    g, width, height, dtype = gaussians, cameras.width, cameras.height, gaussians.xyz.dtype
    covariance = g.covariance3()
    c2w, intrinsics, time = (x.detach().to(dtype) for x in (cameras.c2w, cameras.intrinsics, cameras.time))
    ys, xs = torch.meshgrid(torch.arange(height, dtype=dtype), torch.arange(width, dtype=dtype), indexing="ij")
    pixels = torch.stack([xs, ys], -1) + 0.5
    images, alphas = [], []
    for view in range(len(time)):
        # the slice at the camera's time
        dt = time[view] - g.t
        mean = g.xyz + g.velocity * dt[:, None]
        marginal = torch.exp(-0.5 * (dt / g.sigma_t) ** 2)
        o = g.opacity * marginal
        z = (mean - c2w[view, :3, 3]) @ c2w[view, :3, 2]
        assert mean.shape == (len(g), 3) and z.shape == o.shape == (len(g),)
        keep = (z >= NEAR_PLANE) & (o >= ALPHA_MIN)
        if options.inference:
            keep &= (marginal >= INFERENCE_MIN) & (o >= INFERENCE_MIN)
        keep = keep.nonzero()[:, 0]
        # front to back by the depth of the centre in float32; equal depths in input order
        keep = keep[torch.argsort(z[keep].detach().float(), stable=True)]
        mean2, cov2 = project(mean[keep], covariance[keep], c2w[view], intrinsics[view], width, height)
        assert mean2.shape == (len(keep), 2) and cov2.shape == (len(keep), 2, 2)
        d = pixels[:, :, None] - mean2
        a, b, c = cov2[:, 0, 0], cov2[:, 0, 1], cov2[:, 1, 1]
        q = 0.5 * (c * d[..., 0] ** 2 - 2 * b * d[..., 0] * d[..., 1] + a * d[..., 1] ** 2) / (a * c - b * b)
        alpha = (o[keep] * torch.exp(-q)).clamp(max=ALPHA_MAX)
        alpha = torch.where(alpha >= ALPHA_MIN, alpha, torch.zeros_like(alpha))
        assert d.shape == (height, width, len(keep), 2) and alpha.shape == (height, width, len(keep))
        # A Gaussian that would take the transmittance to 1e-4 or below is not drawn, nor is any behind it.
        after = torch.cumprod(1 - alpha.detach(), -1)
        alpha = torch.where(after > TRANSMITTANCE_MIN, alpha, torch.zeros_like(alpha))
        after = torch.cumprod(1 - alpha, -1)
        before = torch.cat([torch.ones_like(after[..., :1]), after], -1)[..., :-1]
        left = 1 - (alpha * before).sum(-1) if len(keep) else torch.ones(height, width, dtype=dtype)
        images.append((alpha * before) @ g.rgb[keep] + left[..., None] * options.background)
        alphas.append(1 - left)
        assert images[-1].shape == (height, width, 3) and left.shape == (height, width)
    if not images:
        return g.xyz.new_zeros(0, height, width, 3), g.xyz.new_zeros(0, height, width)
    return torch.stack(images), torch.stack(alphas)
