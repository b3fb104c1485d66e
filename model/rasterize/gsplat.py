# SPDX-License-Identifier: GPL-3.0-or-later
"""A CUDA backend: gsplat's kernels, one call a view, because every view has its own time and so its own cloud."""

from __future__ import annotations

import importlib.machinery
import importlib.util

import torch
from torch import Tensor

from ..gaussians import Gaussians4D
from .constants import ALPHA_MIN, BLUR, INFERENCE_MIN, NEAR_PLANE
from .inputs import Cameras, RenderOptions, check_finite


def is_compiled() -> bool:
    """Whether gsplat is here with its extension. The wheel on PyPI has none: its first call would compile for minutes,
    or fail where there is no nvcc."""
    gsplat = importlib.util.find_spec("gsplat")
    # Not find_spec("gsplat.csrc"), which would import gsplat.
    return bool(gsplat and importlib.machinery.PathFinder.find_spec("gsplat.csrc", gsplat.submodule_search_locations))


def rasterize(gaussians: Gaussians4D, cameras: Cameras, options: RenderOptions) -> tuple[Tensor, Tensor]:
    """-> rgb (C,height,width,3), alpha (C,height,width); see `render`. ValueError for NaN or infinity, ImportError
    where gsplat is missing."""
    check_finite(gaussians, cameras)
    try:
        from gsplat import rasterization
    except ImportError as e:
        raise ImportError("rasterizing on CUDA needs gsplat >= 1.5: pip install timesplat[cuda]") from e

    g, width, height, background = gaussians, cameras.width, cameras.height, options.background
    pose = cameras.c2w, cameras.intrinsics, cameras.time
    c2w, intrinsics, time = (x.detach().to(g.xyz.device, torch.float32) for x in pose)
    viewmats = torch.linalg.inv(c2w)
    K = torch.zeros(len(time), 3, 3, device=g.xyz.device)
    K[:, 0, 0], K[:, 1, 1], K[:, 0, 2], K[:, 1, 2] = intrinsics.unbind(-1)
    K[:, 2, 2] = 1
    covariance = g.covariance3()
    symmetric = 0.5 * (covariance + covariance.mT)
    images, alphas = [], []
    for view in range(len(time)):
        dt = time[view] - g.t
        marginal = torch.exp(-0.5 * (dt / g.sigma_t) ** 2)
        o = g.opacity * marginal
        keep = o >= ALPHA_MIN
        if options.inference:
            keep &= (marginal >= INFERENCE_MIN) & (o >= INFERENCE_MIN)
        keep = keep.nonzero()[:, 0]
        if not len(keep):
            nothing = 0 * g.rgb[keep].sum()  # zero, but part of the graph
            images.append((background + nothing).float().expand(height, width, 3))
            alphas.append(nothing.float().expand(height, width))
            continue
        image, alpha, _ = rasterization(
            means=(g.xyz[keep] + g.velocity[keep] * dt[keep, None]).float(),  # (K,3)
            quats=None,
            scales=None,
            opacities=o[keep].float(),  # (K)
            colors=g.rgb[keep].float(),  # (K,3)
            viewmats=viewmats[view : view + 1],  # (1,4,4)
            Ks=K[view : view + 1],  # (1,3,3)
            width=width,
            height=height,
            near_plane=NEAR_PLANE,
            eps2d=BLUR,
            covars=symmetric[keep].float(),  # (K,3,3)
            backgrounds=background.float()[None],  # (1,3)
            rasterize_mode="classic",
        )
        images.append(image[0])
        alphas.append(alpha[0, ..., 0])
    if not images:
        return g.xyz.new_zeros(0, height, width, 3), g.xyz.new_zeros(0, height, width)
    return torch.stack(images).to(g.xyz.dtype), torch.stack(alphas).to(g.xyz.dtype)
