# SPDX-License-Identifier: GPL-3.0-or-later
"""Views as fits need them: copied, joined, averaged down, chosen for validation, and drawn of a scene from around."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ...datagen.rigs import spherical
from ...datagen.sequence import opengl_to_opencv
from ..gaussians import Gaussians4D
from ..rasterize import render
from ..views import Views, pad_to_multiple

VALIDATION_VIEWS = 4
SET_ASIDE = 6  # views, by which it is known how few Gaussians will do
AROUND = 96  # pictures of a scene from other sides
STEEPEST = 58  # degrees of elevation, up and down, of where these are taken
TENSORS = ("rgb", "alpha", "c2w", "intrinsics", "time")  # of Views, as fits use them


def detached(views: Views, device="cpu") -> Views:
    """Copies of the colour, alpha, cameras and times on a device: free of inference mode, and nothing but these."""
    return replace(
        views, depth=None, flow=None, surface=None, **{k: getattr(views, k).to(device).clone() for k in TENSORS}
    )


def joined(a: Views, b: Views) -> Views:
    """The views of `a`, then those of `b`, of the same size; both as from `detached`."""
    return replace(a, **{k: torch.cat([getattr(a, k), getattr(b, k)]) for k in TENSORS})


def downsampled(views: Views, by: int) -> Views:
    """The views (without depth and flow) at 1/by of their size, rounded up; colours averaged as light is."""
    if by == 1:
        return views
    views = pad_to_multiple(views, by)

    def mean(x: Tensor) -> Tensor:  # (V,H,W,C)
        return F.avg_pool2d(x.movedim(-1, 1), by).movedim(1, -1)

    a = views.alpha[..., None]
    alpha = mean(a)
    rgb = mean(views.rgb * a) / alpha.clamp_min(1e-6)
    return replace(views, rgb=rgb, alpha=alpha[..., 0], intrinsics=views.intrinsics / by)


def reduction(views: Views, side: int) -> int:
    """By how much the views are to be averaged down so that no side is longer than `side` pixels; 1 or more."""
    return -(-max(views.size) // side)


def validation_views(views: Views, count: int = VALIDATION_VIEWS) -> Tensor:
    """(at most `count`,) indices of views spread over the clip."""
    order, n = views.time.argsort(stable=True), min(count, len(views))
    return order[[len(views) * (2 * i + 1) // (2 * n) for i in range(n)]]


def set_aside(views: Views) -> tuple[Views, Views]:
    """The views without some of them, spread over the clip, and these: SET_ASIDE, but a quarter at the most, or one;
    of a single view both are it."""
    aside = validation_views(views, min(SET_ASIDE, max(len(views) // 4, 1))).tolist()
    return views[[i for i in range(len(views)) if i not in aside] or aside], views[aside]


@torch.no_grad()
def squared_error(g: Gaussians4D, views: Views) -> float:
    """Mean squared error of the scene's pictures over white, with the paper's inference filters."""
    height, width = views.size
    rgb, _ = render(g, views.c2w, views.intrinsics, views.time, width, height, inference=True)
    return float((rgb - views.over(1.0)).square().mean())


def psnr(g: Gaussians4D, views: Views) -> float:
    """dB of the scene's pictures over white, likewise; 100 at the most."""
    return -10 * math.log10(max(squared_error(g, views), 1e-10))


@torch.no_grad()
def views_around(g: Gaussians4D, views: Views, seed: int = 0, count: int = AROUND) -> Views:
    """`count` pictures of the Gaussians from random sides at frames between the first and the last view, whether or not
    a view shows them, taken as the views are: from their median distance to the origin, with the median of their
    intrinsics."""
    rng = np.random.default_rng([seed, 11])
    distance = float(views.c2w[:, :3, 3].norm(dim=-1).median())
    steepest = math.sin(math.radians(STEEPEST))
    elevations = np.degrees(np.arcsin(rng.uniform(-steepest, steepest, count)))
    poses = [spherical(a, e, distance) for a, e in zip(rng.uniform(0, 360, count), elevations, strict=True)]
    c2w = torch.from_numpy(opengl_to_opencv(np.stack(poses))).to(views.c2w)
    intrinsics = views.intrinsics.median(0).values.expand(count, 4).clone()
    first, last = float(views.time.min()), float(views.time.max())
    frames = round((last - first) / views.frame_step) + 1
    time = first + views.frame_step * torch.from_numpy(rng.integers(frames, size=count)).to(views.time)
    height, width = views.size
    rgb, alpha = render(g, c2w, intrinsics, time, width, height, background=0.0, inference=True)
    rgb = rgb / alpha.clamp_min(1e-4)[..., None]  # straight
    return replace(views, rgb=rgb, alpha=alpha, c2w=c2w, intrinsics=intrinsics, time=time)
