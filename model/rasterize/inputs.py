# SPDX-License-Identifier: GPL-3.0-or-later
"""What a backend is called with: Gaussians, cameras, options. Their shapes are checked here, and here alone."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ..gaussians import Gaussians4D

# Of one Gaussian and of one camera, in the order in which they are checked.
_GAUSSIAN = {"xyz": (3,), "t": (), "velocity": (3,), "sigma_t": (), "scale": (3,), "rotation": (4,), "cov3": (3, 3)}
_GAUSSIAN |= {"rgb": (3,), "opacity": ()}
_CAMERA = {"c2w": (4, 4), "intrinsics": (4,), "time": ()}


@dataclass(frozen=True)
class Cameras:
    """C cameras, each at a time of its own. No gradients flow to them."""

    c2w: Tensor  # (C,4,4) OpenCV axes, a rigid transform
    intrinsics: Tensor  # (C,4) fx fy cx cy in pixels, pixel centres at +0.5
    time: Tensor  # (C) in [-1,1]
    width: int  # pixels, at least 1
    height: int  # pixels, at least 1


@dataclass(frozen=True)
class RenderOptions:
    """How to draw."""

    background: Tensor  # (3,) in the dtype and on the device of the Gaussians, without gradient
    inference: bool  # skip, per view, Gaussians whose marginal or weighted opacity is below INFERENCE_MIN


def _tensors(gaussians: Gaussians4D, cameras: Cameras) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Those of the Gaussians (of cov3 beside scale and rotation, those that are their shape) and of the cameras."""
    unused = ("cov3",) if gaussians.cov3 is None else ("scale", "rotation")
    return {k: getattr(gaussians, k) for k in _GAUSSIAN if k not in unused}, {k: getattr(cameras, k) for k in _CAMERA}


def check_shapes(gaussians: Gaussians4D, cameras: Cameras) -> None:
    """ValueError that names the first tensor of another shape, or not of floating point, or the images' size."""
    for group in _tensors(gaussians, cameras):
        first = next(iter(group.values()))
        rows = first.shape[0] if first.ndim else 0
        for name, x in group.items():
            shape = (rows, *(_GAUSSIAN | _CAMERA)[name])
            if x.shape != shape:
                raise ValueError(f"render: {name} has shape {tuple(x.shape)}, expected {shape}")
            if not x.is_floating_point():
                raise ValueError(f"render: {name} has dtype {x.dtype}, expected floating point")
    if cameras.width < 1 or cameras.height < 1:
        raise ValueError(f"render: image size {cameras.width} x {cameras.height}")


def check_finite(gaussians: Gaussians4D, cameras: Cameras, dtype: torch.dtype | None = None) -> None:
    """ValueError that names the first tensor with a NaN or an infinity (once turned into `dtype`)."""
    for group in _tensors(gaussians, cameras):
        for name, x in group.items():
            x = x.detach().to(dtype or x.dtype)
            # One pass; the sum of finite numbers may overflow, so only a suspect is looked at closely.
            if not x.sum().isfinite() and not x.isfinite().all():
                raise ValueError(f"render: {name} has {int((~x.isfinite()).sum())} values that are NaN or infinite")


def colour(background: float | Tensor, like: Tensor) -> Tensor:
    """(3,) of one number or a (3,) tensor, as `like` is. ValueError for another shape, NaN or infinity."""
    x = torch.as_tensor(background, dtype=like.dtype, device=like.device).detach()
    if x.numel() not in (1, 3) or x.ndim > 1 or not all(map(math.isfinite, x.view(-1).tolist())):
        raise ValueError("render: background must be one finite number or three")
    return x.expand(3)
