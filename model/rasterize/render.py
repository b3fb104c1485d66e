# SPDX-License-Identifier: GPL-3.0-or-later
"""The rasteriser's one function, `render`: checks what it is given and hands it to a backend."""

from __future__ import annotations

import importlib

import torch
from torch import Tensor

from ..gaussians import DynamicScene, Gaussians4D
from ..views import BACKGROUND
from . import gsplat
from .inputs import Cameras, RenderOptions, check_shapes, colour

BACKENDS = ("cpu", "gsplat", "triton", "reference")  # modules of this package with a function `rasterize`


def render(
    scene: Gaussians4D | DynamicScene,
    c2w: Tensor,
    intrinsics: Tensor,
    time: Tensor,
    width: int,
    height: int,
    *,
    background: float | Tensor = BACKGROUND,
    inference: bool = False,
    backend: str | None = None,
) -> tuple[Tensor, Tensor]:
    """Images of a scene from C cameras, each at its own time (paper, section 2.1).

    At a camera's time τ a Gaussian is the 3D one with mean xyz + velocity (τ - t), covariance Σ_3 and opacity
    o exp(-½ ((τ - t) / σ_t)²); slicing, projection and blending all happen here.

    scene: N 4D Gaussians without batch dimensions, floating tensors on one device, differentiable (of cov3 its
    symmetric part counts); or another moving scene, which is asked for its state once for every distinct time.
    Cameras, without gradients: c2w (C,4,4) OpenCV axes, a rigid transform; intrinsics (C,4) fx fy cx cy in pixels,
    pixel centres at +0.5; time (C) in [-1,1]; width and height in pixels.
    background: one value or (3,). inference: skip, per view, Gaussians whose marginal or weighted opacity is
    below 0.05 (appendix A.2); not for training, where it would cut gradients. backend: "cpu" (float32 inside),
    "gsplat" (CUDA), "triton" (CUDA with nothing but torch) or "reference" (slow; computes in the inputs'
    precision); None goes by the device, and on CUDA takes gsplat where it is installed compiled.

    -> rgb (C,height,width,3) over the background, alpha (C,height,width), in the dtype of xyz.
    ValueError for a wrong shape, NaN or infinity, naming the tensor; ImportError where the backend's library is
    missing."""
    if not isinstance(scene, Gaussians4D):
        several = torch.get_num_threads() if time.device.type == "cpu" else 1  # moments drawn at once
        images = [None] * len(time)
        for moments in time.unique().split(several):
            here = torch.isin(time, moments).nonzero()[:, 0]
            cameras = c2w[here], intrinsics[here], time[here], width, height
            now = _side_by_side([scene.at(t) for t in moments.tolist()], moments)
            drawn = render(now, *cameras, background=background, inference=inference, backend=backend)
            for i, rgb, alpha in zip(here.tolist(), *drawn, strict=True):
                images[i] = (rgb, alpha)
        return tuple(map(torch.stack, zip(*images, strict=True)))
    cameras = Cameras(c2w, intrinsics, time, int(width), int(height))
    check_shapes(scene, cameras)
    options = RenderOptions(colour(background, like=scene.xyz), bool(inference))
    if backend is None:
        backend = ("gsplat" if gsplat.is_compiled() else "triton") if scene.xyz.is_cuda else "cpu"
    if backend not in BACKENDS:
        raise ValueError(f"render: backend {backend!r}, expected one of {BACKENDS}")
    # Only now: numba and triton take their time, and need not be there.
    return importlib.import_module(f".{backend}", __package__).rasterize(scene, cameras, options)


def _side_by_side(states: list[Gaussians4D], moments: Tensor) -> Gaussians4D:
    """The states of a scene at (K,) moments as one cloud, in which each is there at its own moment alone: so the
    threads of the CPU backend share the views of several moments."""
    if len(states) == 1:
        return states[0]
    apart = float(moments.diff().abs().min())
    both = Gaussians4D.cat(states)
    both.t = moments.repeat_interleave(torch.tensor([len(s) for s in states], device=moments.device)).to(both.t)
    both.sigma_t = torch.full_like(both.t, apart / 10)  # ten σ away the marginal is e⁻⁵⁰
    return both
