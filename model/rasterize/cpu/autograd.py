# SPDX-License-Identifier: GPL-3.0-or-later
"""The CPU backend as a differentiable function of torch's: which kernel runs on what, view by view and tile by tile."""

from __future__ import annotations

import itertools

import numpy as np
import torch
from torch import Tensor

from ...gaussians import Gaussians4D
from ...parallel import parallel_for
from ..inputs import Cameras, RenderOptions, check_finite
from .blend import PLANE, blend_tiles, unblend_tiles
from .chain_rule import chain_rule
from .layout import SUMS, TILE
from .project import all_finite, project_view
from .simd import ROWS


def rasterize(gaussians: Gaussians4D, cameras: Cameras, options: RenderOptions) -> tuple[Tensor, Tensor]:
    """-> rgb (C,height,width,3), alpha (C,height,width); see `render`. ValueError for what is NaN or infinite in
    float32."""
    g = gaussians
    # Scale and rotation as they are: torch would take as long for the covariances as all the rest takes.
    shape = (g.scale, g.rotation) if g.cov3 is None else (g.cov3, None)
    tensors = g.xyz, g.t, g.velocity, g.sigma_t, *shape, g.rgb, g.opacity
    inputs = tuple(None if x is None else _array(x).reshape(-1) for x in tensors)
    views = tuple(_array(x, torch.float64) for x in (cameras.c2w, cameras.intrinsics, cameras.time))
    if not (all_finite(tuple(x for x in inputs if x is not None)) and all(np.isfinite(x).all() for x in views)):
        check_finite(gaussians, cameras, torch.float32)  # takes ten times as long, but knows the name
    size = cameras.width, cameras.height
    return _Rasterize.apply(inputs, views, size, _array(options.background), options.inference, *tensors)


class _Rasterize(torch.autograd.Function):
    """inputs: the tensors as flat float32 arrays; cameras: c2w (C,4,4), intrinsics (C,4), time (C) as float64 arrays;
    size: width, height; background: (3,) float32 array; tensors: xyz (N,3), t (N), velocity (N,3), sigma_t (N), scale
    (N,3) and rotation (N,4) or Σ_3 (N,3,3) and None, rgb (N,3), opacity (N)."""

    @staticmethod
    def forward(ctx, inputs, cameras, size, background, inference, *tensors):
        ctx.save_for_backward(*tensors)  # so that torch notices if they are changed in place before backward
        (width, height), views = size, len(cameras[0])
        tiles = -(-width // TILE) * -(-height // TILE)
        image, alpha = np.empty((views, height, width, 3), np.float32), np.empty((views, height, width), np.float32)
        kept = np.empty((views, tiles, TILE // ROWS, 2, PLANE), np.float32)
        drawn = parallel_for(
            [(c,) for c in range(views)],
            lambda c: project_view(c, inputs, cameras, width, height, inference),
        )  # per view: ids, P, starts, pairs, slots, first

        def blend(c, band):
            _, P, starts, pairs, _, _ = drawn[c]
            blend_tiles(band, P, starts, pairs, background, image[c], alpha[c], kept[c])

        parallel_for(itertools.product(range(views), _bands(width, height)), blend)
        ctx.saved = inputs, cameras, size, background, drawn, kept
        dtype = tensors[0].dtype
        return torch.from_numpy(image).to(dtype), torch.from_numpy(alpha).to(dtype)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, g_image, g_alpha):
        tensors, (inputs, cameras, (width, height), background, drawn, kept) = ctx.saved_tensors, ctx.saved
        g_image, g_alpha, views = _array(g_image), _array(g_alpha), len(drawn)
        sums = [np.zeros((len(pairs), SUMS), np.float32) for _, _, _, pairs, _, _ in drawn]

        def unblend(c, band):
            _, P, starts, pairs, slots, _ = drawn[c]
            unblend_tiles(band, P, starts, pairs, slots, background, g_image[c], g_alpha[c], kept[c], sums[c])

        parallel_for(itertools.product(range(views), _bands(width, height)), unblend)
        out = tuple(None if x is None else np.zeros(x.shape, np.float32) for x in inputs)
        count, parts = len(inputs[1]), torch.get_num_threads()

        def chain_part(part):  # every Gaussian has one owner, who adds the views in their order
            own = part * count // parts, (part + 1) * count // parts
            for c, (ids, _, _, _, _, first) in enumerate(drawn):
                chain_rule(c, own, ids, first, sums[c], inputs, cameras, width, height, out)

        parallel_for([(k,) for k in range(parts)], chain_part)
        return *[None] * 5, *map(_gradient, out, tensors)


def _bands(width: int, height: int) -> list[tuple[int, int]]:
    """Jobs within a view: rows of tiles, as (first, last) tile."""
    across, down = -(-width // TILE), -(-height // TILE)
    return [(k * across, k * across + across) for k in range(down)]


def _array(x: Tensor, dtype: torch.dtype = torch.float32) -> np.ndarray:
    """A contiguous array of a CPU tensor of any shape; its own memory where that will do."""
    x = x.detach()
    return (x if x.dtype == dtype and x.is_contiguous() else x.to(dtype).contiguous()).numpy()


def _gradient(flat: np.ndarray | None, tensor: Tensor | None) -> Tensor | None:
    """A flat array of gradients in the shape and dtype of the tensor that they are of."""
    return None if flat is None else torch.from_numpy(flat.reshape(tensor.shape)).to(tensor.dtype)
