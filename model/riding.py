# SPDX-License-Identifier: GPL-3.0-or-later
"""Where Gaussians are that ride on paths: the pose of a path put after the pose in its moving frame, N times, and the
way back for gradients. One compiled pass each: in torch's single operations it took a third of a step of a fit."""

from __future__ import annotations

import numba
import numpy as np
import torch
from torch import Tensor

from .parallel import chunks, parallel_for

CHUNK = 8192  # Gaussians that a thread takes at once


class Ride(torch.autograd.Function):
    """path (N,) int64, place (P,3), turn (P,4) unit quaternions, without gradients; offset (N,3), rotation (N,4) -> the
    places (N,3) and quaternions (N,4); float32 on the CPU."""

    @staticmethod
    def forward(ctx, path: Tensor, place: Tensor, turn: Tensor, offset: Tensor, rotation: Tensor):
        ctx.path, ctx.turn = path.numpy(), turn.contiguous().numpy()
        xyz, out = np.empty((len(path), 3), np.float32), np.empty((len(path), 4), np.float32)
        inputs = (place.contiguous().numpy(), ctx.turn, *(x.detach().contiguous().numpy() for x in (offset, rotation)))
        parallel_for(chunks(len(path), CHUNK), lambda a, b: _ride(a, b, ctx.path, *inputs, xyz, out))
        return torch.from_numpy(xyz), torch.from_numpy(out)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, g_xyz: Tensor, g_out: Tensor):
        g_offset, g_rotation = np.empty((len(ctx.path), 3), np.float32), np.empty((len(ctx.path), 4), np.float32)
        told = ctx.path, ctx.turn, g_xyz.contiguous().numpy(), g_out.contiguous().numpy()
        parallel_for(chunks(len(ctx.path), CHUNK), lambda a, b: _ride_back(a, b, *told, g_offset, g_rotation))
        return None, None, None, torch.from_numpy(g_offset), torch.from_numpy(g_rotation)


@numba.njit(cache=True, nogil=True, fastmath=True)
def _ride(begin, end, path, place, turn, offset, rotation, xyz, out):
    for n in range(begin, end):
        p = path[n]
        w, x, y, z = turn[p, 0], turn[p, 1], turn[p, 2], turn[p, 3]
        a, b, c = offset[n, 0], offset[n, 1], offset[n, 2]
        sx, sy, sz = 2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)
        xyz[n, 0] = place[p, 0] + a + w * sx + y * sz - z * sy
        xyz[n, 1] = place[p, 1] + b + w * sy + z * sx - x * sz
        xyz[n, 2] = place[p, 2] + c + w * sz + x * sy - y * sx
        d, e, f, g = rotation[n, 0], rotation[n, 1], rotation[n, 2], rotation[n, 3]
        out[n, 0] = w * d - x * e - y * f - z * g
        out[n, 1] = w * e + x * d + y * g - z * f
        out[n, 2] = w * f - x * g + y * d + z * e
        out[n, 3] = w * g + x * f - y * e + z * d


@numba.njit(cache=True, nogil=True, fastmath=True)
def _ride_back(begin, end, path, turn, g_xyz, g_out, g_offset, g_rotation):
    """Both maps are turns, so that their transposes are those by the conjugate."""
    for n in range(begin, end):
        p = path[n]
        w, x, y, z = turn[p, 0], -turn[p, 1], -turn[p, 2], -turn[p, 3]
        a, b, c = g_xyz[n, 0], g_xyz[n, 1], g_xyz[n, 2]
        sx, sy, sz = 2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)
        g_offset[n, 0] = a + w * sx + y * sz - z * sy
        g_offset[n, 1] = b + w * sy + z * sx - x * sz
        g_offset[n, 2] = c + w * sz + x * sy - y * sx
        d, e, f, g = g_out[n, 0], g_out[n, 1], g_out[n, 2], g_out[n, 3]
        g_rotation[n, 0] = w * d - x * e - y * f - z * g
        g_rotation[n, 1] = w * e + x * d + y * g - z * f
        g_rotation[n, 2] = w * f - x * g + y * d + z * e
        g_rotation[n, 3] = w * g + x * f - y * e + z * d
