# SPDX-License-Identifier: GPL-3.0-or-later
"""The differentiable rasteriser of 4D Gaussians: one function, a CPU and a CUDA backend, a slow reference.

What is computed is written down in `reference.py`. All backends follow gsplat's conventions ("classic" mode,
EWA projection with clamped slopes, +0.3 px² on the diagonal, near plane 0.01, alpha in [1/255, 0.999], stop at
transmittance 1e-4), so that a model trained with one renders the same with another.
"""

from __future__ import annotations

import importlib.machinery
import importlib.util
import math

import torch
from torch import Tensor

from ..gaussians import DynamicScene, Gaussians4D

BACKENDS = ("cpu", "cuda", "triton", "reference")
NEAR = 0.01  # nearest depth of a centre
BLUR = 0.3  # px², added to the 2D covariance's diagonal
MARGIN = 0.3  # the Jacobian's slopes are clamped to the image widened by this share of half its size
ALPHA_MIN, ALPHA_MAX = 1 / 255, 0.999  # fainter is not drawn, denser is clamped
T_STOP = 1e-4  # a pixel stops before its transmittance gets this low
FILTER = 0.05  # the paper's inference filters, on the marginal and on the weighted opacity (appendix A.2)


def rasterize(
    xyz: Tensor,
    t: Tensor,
    velocity: Tensor,
    sigma_t: Tensor,
    covariance: Tensor,
    rgb: Tensor,
    opacity: Tensor,
    c2w: Tensor,
    intrinsics: Tensor,
    time: Tensor,
    width: int,
    height: int,
    *,
    background: float | Tensor = 1.0,
    inference: bool = False,
    backend: str | None = None,
) -> tuple[Tensor, Tensor]:
    """Images of N 4D Gaussians in kinematic form from C cameras, each at its own time (paper, section 2.1).

    At a camera's time τ a Gaussian is the 3D one with mean xyz + velocity (τ - t), covariance Σ_3 and opacity
    o exp(-½ ((τ - t) / σ_t)²); slicing, projection and blending all happen here.

    xyz (N,3), t (N) in [-1,1], velocity (N,3) per unit of t, sigma_t (N) > 0, covariance (N,3,3) = Σ_3
    (its symmetric part counts), rgb (N,3) any values, opacity (N) in 0..1: floating tensors on one device,
    differentiable. Cameras, without gradients: c2w (C,4,4) OpenCV axes, a rigid transform; intrinsics (C,4)
    fx fy cx cy in pixels, pixel centres at +0.5; time (C) in [-1,1].
    background: one value or (3,). inference: skip, per view, Gaussians whose marginal or weighted opacity is
    below 0.05 (appendix A.2); not for training, where it would cut gradients. backend: "cpu" (float32 inside),
    "cuda" (gsplat), "triton" (CUDA with nothing but torch) or "reference" (slow; computes in the inputs'
    precision); None goes by the device, and on CUDA takes gsplat where it is installed compiled.

    -> rgb (C,height,width,3) over the background, alpha (C,height,width), in the dtype of xyz.
    ValueError for a wrong shape, NaN or infinity, naming the tensor."""
    gaussians = {
        "xyz": (xyz, (3,)), "t": (t, ()), "velocity": (velocity, (3,)), "sigma_t": (sigma_t, ()),
        "covariance": (covariance, (3, 3)), "rgb": (rgb, (3,)), "opacity": (opacity, ()),
    }  # fmt: skip
    return _rasterize(gaussians, c2w, intrinsics, time, width, height, background, inference, backend)


def _rasterize(
    gaussians, c2w, intrinsics, time, width, height, background=1.0, inference=False, backend=None
) -> tuple[Tensor, Tensor]:
    """`rasterize` of Gaussians given as name -> (tensor, shape of a row); for the CPU's backend, scale and rotation
    may stand in for the covariance."""
    cameras = {"c2w": (c2w, (4, 4)), "intrinsics": (intrinsics, (4,)), "time": (time, ())}
    for group in (gaussians, cameras):
        first = next(iter(group.values()))[0]
        rows = first.shape[0] if first.ndim else 0
        for name, (x, shape) in group.items():
            if x.shape != (rows, *shape):
                raise ValueError(f"rasterize: {name} has shape {tuple(x.shape)}, expected {(rows, *shape)}")
            if not x.is_floating_point():
                raise ValueError(f"rasterize: {name} has dtype {x.dtype}, expected floating point")
    if width < 1 or height < 1:
        raise ValueError(f"rasterize: image size {width} x {height}")
    xyz = gaussians["xyz"][0]
    background = torch.as_tensor(background, dtype=xyz.dtype, device=xyz.device).detach()
    if (
        background.numel() not in (1, 3)
        or background.ndim > 1
        or not all(map(math.isfinite, background.view(-1).tolist()))
    ):
        raise ValueError("rasterize: background must be one finite number or three")

    if backend is None:
        backend = ("cuda" if _gsplat_is_compiled() else "triton") if xyz.is_cuda else "cpu"
    if backend == "cpu":
        from .cpu import rasterize as run
    elif backend == "cuda":
        from .gsplat import rasterize as run
    elif backend == "triton":
        from .triton_kernels import rasterize as run
    elif backend == "reference":
        from .reference import rasterize as run
    else:
        raise ValueError(f"rasterize: backend {backend!r}, expected one of {BACKENDS}")
    inputs = {name: x for name, (x, _) in (gaussians | cameras).items()}
    if backend != "cpu":
        _check_finite(inputs)
    out = run(*inputs.values(), (int(width), int(height)), background.expand(3), bool(inference))
    if out is None:  # the CPU's backend looks for itself, in a tenth of the time
        _check_finite(inputs, torch.float32)
    return out


def _gsplat_is_compiled() -> bool:
    """Whether gsplat is here with its extension. The wheel on PyPI has none: its first call would compile for minutes,
    or fail where there is no nvcc."""
    gsplat = importlib.util.find_spec("gsplat")
    # Not find_spec("gsplat.csrc"), which would import gsplat.
    return bool(gsplat and importlib.machinery.PathFinder.find_spec("gsplat.csrc", gsplat.submodule_search_locations))


def _check_finite(tensors: dict[str, Tensor], dtype=None) -> None:
    """ValueError that names the first tensor with a NaN or an infinity (once turned into `dtype`)."""
    for name, x in tensors.items():
        x = x.detach().to(dtype or x.dtype)
        # One pass; the sum of finite numbers may overflow, so only a suspect is looked at closely.
        if not x.sum().isfinite() and not x.isfinite().all():
            raise ValueError(f"rasterize: {name} has {int((~x.isfinite()).sum())} values that are NaN or infinite")


def render(
    scene: Gaussians4D | DynamicScene, c2w: Tensor, intrinsics: Tensor, time: Tensor, width: int, height: int, **kw
) -> tuple[Tensor, Tensor]:
    """`rasterize` of a cloud without batch dimensions, or of another moving scene, which is asked for its
    state once for every distinct time; same cameras, keywords, results and errors."""
    if not isinstance(scene, Gaussians4D):
        images = [None] * len(time)
        for t in time.unique().tolist():
            here = (time == t).nonzero()[:, 0].tolist()
            drawn = render(scene.at(t), c2w[here], intrinsics[here], 0 * time[here], width, height, **kw)
            for i, rgb, alpha in zip(here, *drawn, strict=True):
                images[i] = (rgb, alpha)
        return tuple(map(torch.stack, zip(*images, strict=True)))
    g = scene
    if g.cov3 is None and not g.xyz.is_cuda and kw.get("backend") in (None, "cpu"):
        # Compiled too: torch would take as long for the covariances as all the rest takes.
        shape = {"scale": (g.scale, (3,)), "rotation": (g.rotation, (4,))}
    else:
        shape = {"covariance": (g.covariance3(), (3, 3))}
    gaussians = {
        "xyz": (g.xyz, (3,)), "t": (g.t, ()), "velocity": (g.velocity, (3,)), "sigma_t": (g.sigma_t, ()),
        **shape, "rgb": (g.rgb, (3,)), "opacity": (g.opacity, ()),
    }  # fmt: skip
    return _rasterize(gaussians, c2w, intrinsics, time, width, height, **kw)
