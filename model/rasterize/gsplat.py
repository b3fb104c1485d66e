# SPDX-License-Identifier: GPL-3.0-or-later
"""The CUDA backend: gsplat's kernels, one call a view, because every view has its own time and so its own cloud."""

from __future__ import annotations

import torch

from .constants import ALPHA_MIN, INFERENCE_MIN, NEAR_PLANE


def rasterize(xyz, t, velocity, sigma_t, covariance, rgb, opacity, c2w, intrinsics, time, size, background, inference):
    """See `timesplat.model.rasterize.rasterize`; size = (width, height), background a (3,) tensor.
    ImportError where gsplat is missing."""
    try:
        from gsplat import rasterization
    except ImportError as e:
        raise ImportError("rasterizing on CUDA needs gsplat >= 1.5: pip install timesplat[cuda]") from e

    width, height = size
    c2w, intrinsics, time = (x.detach().to(xyz.device, torch.float32) for x in (c2w, intrinsics, time))
    viewmats = torch.linalg.inv(c2w)
    K = torch.zeros(len(time), 3, 3, device=xyz.device)
    K[:, 0, 0], K[:, 1, 1], K[:, 0, 2], K[:, 1, 2] = intrinsics.unbind(-1)
    K[:, 2, 2] = 1
    symmetric = 0.5 * (covariance + covariance.mT)
    images, alphas = [], []
    for view in range(len(time)):
        dt = time[view] - t
        marginal = torch.exp(-0.5 * (dt / sigma_t) ** 2)
        o = opacity * marginal
        keep = o >= ALPHA_MIN
        if inference:
            keep &= (marginal >= INFERENCE_MIN) & (o >= INFERENCE_MIN)
        keep = keep.nonzero()[:, 0]
        if not len(keep):
            nothing = 0 * rgb[keep].sum()  # zero, but part of the graph
            images.append((background + nothing).float().expand(height, width, 3))
            alphas.append(nothing.float().expand(height, width))
            continue
        image, alpha, _ = rasterization(
            means=(xyz[keep] + velocity[keep] * dt[keep, None]).float(),
            quats=None,
            scales=None,
            opacities=o[keep].float(),
            colors=rgb[keep].float(),
            viewmats=viewmats[view : view + 1],
            Ks=K[view : view + 1],
            width=width,
            height=height,
            near_plane=NEAR_PLANE,
            covars=symmetric[keep].float(),
            backgrounds=background.float()[None],
            rasterize_mode="classic",
        )
        images.append(image[0])
        alphas.append(alpha[0, ..., 0])
    if not images:
        return xyz.new_zeros(0, height, width, 3), xyz.new_zeros(0, height, width)
    return torch.stack(images).to(xyz.dtype), torch.stack(alphas).to(xyz.dtype)
