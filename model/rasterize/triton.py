# SPDX-License-Identifier: GPL-3.0-or-later
"""The second CUDA backend: Triton kernels, for machines that have torch and a driver but no CUDA compiler.

The steps are the CPU backend's: cull by time, opacity and depth; sort the survivors by depth; project them in that
order (float64, as there); list for every tile of 16² pixels the Gaussians whose box reaches it; blend each tile
front to back (float32), groups of Gaussians against all its pixels. The backward pass walks the lists back to
front and recovers each transmittance by division. Every (tile, Gaussian) pair owns one row of a gradient buffer,
which is then summed in a fixed order: no atomics, the same bits on every run.

Developed with Triton's interpreter (TRITON_INTERPRET=1, set before triton is imported), which runs the kernels on
CPU tensors, and with its compiler, which needs no card; not yet run on one, nor timed.
"""

from __future__ import annotations

import torch
from torch import Tensor

try:
    import triton
except ImportError as e:
    raise ImportError("rasterizing on CUDA without gsplat needs triton, a part of torch for CUDA on Linux") from e

from ..gaussians import Gaussians4D
from . import triton_kernels as kernels
from .constants import SLOPE_MARGIN
from .inputs import Cameras, RenderOptions, check_finite

TILE, ROW = kernels.TILE.value, kernels.ROW.value


def rasterize(gaussians: Gaussians4D, cameras: Cameras, options: RenderOptions) -> tuple[Tensor, Tensor]:
    """-> rgb (C,height,width,3), alpha (C,height,width); see `render`. ValueError for NaN or infinity, and for tensors
    that are not on a CUDA device."""
    g = gaussians
    check_finite(g, cameras)
    if not g.xyz.is_cuda and isinstance(kernels.blend, triton.JITFunction):  # and not interpreted
        raise ValueError('render: backend "triton" needs tensors on a CUDA device')
    tensors = g.xyz, g.t, g.velocity, g.sigma_t, g.covariance3(), g.rgb, g.opacity
    with torch.cuda.device_of(g.xyz):
        return _Rasterize.apply(cameras, options, *tensors)


def _rows_of(cameras: Cameras, device: torch.device) -> Tensor:
    """-> (C, CAMERA) float64; see triton_kernels.py."""
    pose = cameras.c2w, cameras.intrinsics, cameras.time
    c2w, intrinsics, time = (x.detach().to(device, torch.float64) for x in pose)
    f, centre = intrinsics[:, :2], intrinsics[:, 2:]
    size = torch.tensor([cameras.width, cameras.height], dtype=torch.float64, device=device)
    low, high = -centre / f - SLOPE_MARGIN * 0.5 * size / f, (size - centre) / f + SLOPE_MARGIN * 0.5 * size / f
    bounds = torch.stack([low, high], -1).flatten(1)
    return torch.cat([c2w[:, :3].flatten(1), intrinsics, bounds, time[:, None]], 1).contiguous()


class _Rasterize(torch.autograd.Function):
    """tensors: xyz (N,3), t (N), velocity (N,3), sigma_t (N), covariance (N,3,3), rgb (N,3), opacity (N)."""

    @staticmethod
    def forward(ctx, cameras, options, *tensors):
        ctx.save_for_backward(*tensors)
        xyz, t, velocity, sigma_t, covariance, rgb, opacity = (x.detach().float().contiguous() for x in tensors)
        width, height, device, count = cameras.width, cameras.height, xyz.device, len(xyz)
        cameras, background = _rows_of(cameras, device), options.background.float().contiguous()
        views = len(cameras)
        across, down = -(-width // TILE), -(-height // TILE)

        depth = torch.empty(views * count, device=device)
        grid = (triton.cdiv(count, 128), views)
        kernels.cull[grid](xyz, t, velocity, sigma_t, opacity, cameras, depth, count, options.inference, 128)
        ids = (depth >= 0).nonzero()[:, 0]
        ids = ids[depth[ids].argsort(stable=True)].int()  # equal depths stay in the order of the input
        P = torch.empty(len(ids), ROW, device=device)
        box = torch.empty(len(ids), 3, dtype=torch.int32, device=device)
        kernels.project[(triton.cdiv(len(ids), 128),)](
            ids, xyz, t, velocity, sigma_t, covariance, rgb, opacity, cameras, P, box,
            len(ids), count, width, height, across, down, 128,
        )  # fmt: skip

        # The pairs (tile, row), first row after row, then sorted by tile, which keeps each tile's rows by depth.
        first, wide, many = box.unbind(1)
        ends = many.cumsum(0)
        rows = torch.repeat_interleave(many)
        place = torch.arange(len(rows), device=device) - (ends - many)[rows]
        tile = first[rows] + place // wide[rows] * across + place % wide[rows]
        tile, places = tile.int().sort(stable=True)
        rows, places = rows[places].int(), places.int()
        tiles = views * across * down
        starts = torch.searchsorted(tile, torch.arange(tiles + 1, device=device), out_int32=True)

        shape = (views, height, width)
        image, alpha, left = (torch.empty(s, device=device) for s in ((*shape, 3), shape, shape))
        last = torch.empty(shape, dtype=torch.int32, device=device)
        kernels.blend[(tiles,)](P, rows, starts, background, image, alpha, left, last, width, height, across, down)
        ctx.saved = cameras, background, ids, P, ends, rows, places, starts, left, last
        return image.to(tensors[0].dtype), alpha.to(tensors[0].dtype)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *grads):
        inputs = [x.detach().float().contiguous() for x in ctx.saved_tensors]
        xyz, t, velocity, sigma_t, covariance, _, opacity = inputs
        g_image, g_alpha = (g.float().contiguous() for g in grads)
        cameras, background, ids, P, ends, rows, places, starts, left, last = ctx.saved
        views, height, width = left.shape
        sums, S = torch.zeros(len(rows), ROW, device=xyz.device), torch.empty_like(P)
        kernels.unblend[(len(starts) - 1,)](
            P, rows, places, starts, background, g_image, g_alpha, left, last, sums,
            width, height, -(-width // TILE), -(-height // TILE),
        )  # fmt: skip
        kernels.add_pairs[(triton.cdiv(len(ids), 8),)](sums, ends, S, len(ids), 8, num_warps=1)
        slots = torch.full((views * len(xyz),), -1, dtype=torch.int32, device=xyz.device)
        slots[ids.long()] = torch.arange(len(ids), dtype=torch.int32, device=xyz.device)
        out = [torch.empty_like(x) for x in inputs]
        kernels.chain_rule[(triton.cdiv(len(xyz), 128),)](
            slots, P, S, xyz, t, velocity, sigma_t, covariance, opacity, cameras, *out, views, len(xyz), 128
        )
        return None, None, *(x.to(y.dtype) for x, y in zip(out, ctx.saved_tensors, strict=True))
