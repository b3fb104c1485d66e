# SPDX-License-Identifier: GPL-3.0-or-later
"""Linear blend skinning: Gaussians moved by the control points near them, each of which turns what is around it about
its place at rest. One compiled pass each way: in torch's single operations it took half of a step of a fit."""

from __future__ import annotations

import numba
import numpy as np
import torch
from torch import Tensor

from ..parallel import chunks, parallel_for

CHUNK = 4096  # Gaussians that a thread takes at once


class Skin(torch.autograd.Function):
    """near (N,K) int32 and weight (N,K) of sum 1, which control points move a Gaussian and how much; rest (C,3), where
    these are at rest: without gradients. place (C,3) and turn (C,4) unit quaternions, where they are; xyz (N,3) and
    rotation (N,4) of the Gaussians at rest -> xyz (N,3), Σ weight (place + turn (xyz - rest)), and unit rotation
    (N,4), (Σ weight turn) rotation; float32 on the CPU."""

    @staticmethod
    def forward(ctx, near, weight, rest, place, turn, xyz, rotation):
        ctx.inputs = [x.detach().contiguous().numpy() for x in (near, weight, rest, place, turn, xyz, rotation)]
        moved, turned = np.empty((len(xyz), 3), np.float32), np.empty((len(xyz), 4), np.float32)
        parallel_for(chunks(len(xyz), CHUNK), lambda a, b: _skin(a, b, *ctx.inputs, moved, turned))
        return torch.from_numpy(moved), torch.from_numpy(turned)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, g_moved: Tensor, g_turned: Tensor):
        count, told = len(ctx.inputs[5]), (g_moved.contiguous().numpy(), g_turned.contiguous().numpy())
        g_xyz, g_rotation = np.empty((count, 3), np.float32), np.empty((count, 4), np.float32)
        parts = chunks(count, CHUNK)  # each adds up by itself, so that the sum is the same on any number of threads
        sums = np.zeros((len(parts), len(ctx.inputs[2]), 7), np.float32)
        jobs = [(i, *part) for i, part in enumerate(parts)]
        parallel_for(jobs, lambda i, a, b: _skin_back(a, b, *ctx.inputs, *told, g_xyz, g_rotation, sums[i]))
        g = torch.from_numpy(sums.sum(0))
        return None, None, None, g[:, :3], g[:, 3:], torch.from_numpy(g_xyz), torch.from_numpy(g_rotation)


@numba.njit(cache=True, nogil=True, fastmath=True)
def _skin(begin, end, near, weight, rest, place, turn, xyz, rotation, moved, turned):
    for n in range(begin, end):
        px = py = pz = qw = qx = qy = qz = np.float32(0)
        for k in range(near.shape[1]):
            c, u = near[n, k], weight[n, k]
            w, x, y, z = turn[c, 0], turn[c, 1], turn[c, 2], turn[c, 3]
            a, b, d = xyz[n, 0] - rest[c, 0], xyz[n, 1] - rest[c, 1], xyz[n, 2] - rest[c, 2]
            sx, sy, sz = 2 * (y * d - z * b), 2 * (z * a - x * d), 2 * (x * b - y * a)
            px += u * (place[c, 0] + a + w * sx + y * sz - z * sy)
            py += u * (place[c, 1] + b + w * sy + z * sx - x * sz)
            pz += u * (place[c, 2] + d + w * sz + x * sy - y * sx)
            qw += u * w
            qx += u * x
            qy += u * y
            qz += u * z
        moved[n, 0], moved[n, 1], moved[n, 2] = px, py, pz
        _normal_product(qw, qx, qy, qz, rotation[n], turned[n])


@numba.njit(cache=True, nogil=True, fastmath=True)
def _normal_product(w, x, y, z, q, out):
    """Writes the product of two quaternions, at unit length; -> one over the length that it had."""
    e, f, g, h = q[0], q[1], q[2], q[3]
    a, b = w * e - x * f - y * g - z * h, w * f + x * e + y * h - z * g
    c, d = w * g - x * h + y * e + z * f, w * h + x * g - y * f + z * e
    scale = np.float32(1 / np.sqrt(a * a + b * b + c * c + d * d + 1e-20))
    out[0], out[1], out[2], out[3] = a * scale, b * scale, c * scale, d * scale
    return scale


@numba.njit(cache=True, nogil=True, fastmath=True)
def _skin_back(begin, end, near, weight, rest, place, turn, xyz, rotation, g_moved, g_turned, g_xyz, g_rotation, sums):
    unit = np.empty(4, np.float32)
    for n in range(begin, end):
        qw = qx = qy = qz = np.float32(0)
        for k in range(near.shape[1]):
            c, u = near[n, k], weight[n, k]
            qw += u * turn[c, 0]
            qx += u * turn[c, 1]
            qy += u * turn[c, 2]
            qz += u * turn[c, 3]
        scale = _normal_product(qw, qx, qy, qz, rotation[n], unit)
        along = (
            unit[0] * g_turned[n, 0] + unit[1] * g_turned[n, 1] + unit[2] * g_turned[n, 2] + unit[3] * g_turned[n, 3]
        )
        p0, p1 = (g_turned[n, 0] - unit[0] * along) * scale, (g_turned[n, 1] - unit[1] * along) * scale
        p2, p3 = (g_turned[n, 2] - unit[2] * along) * scale, (g_turned[n, 3] - unit[3] * along) * scale
        e, f, g, h = rotation[n, 0], rotation[n, 1], rotation[n, 2], rotation[n, 3]
        # Of a product's factors: the gradient times the other one's conjugate.
        bw, bx = p0 * e + p1 * f + p2 * g + p3 * h, -p0 * f + p1 * e - p2 * h + p3 * g
        by, bz = -p0 * g + p1 * h + p2 * e - p3 * f, -p0 * h - p1 * g + p2 * f + p3 * e
        g_rotation[n, 0] = qw * p0 + qx * p1 + qy * p2 + qz * p3
        g_rotation[n, 1] = qw * p1 - qx * p0 - qy * p3 + qz * p2
        g_rotation[n, 2] = qw * p2 + qx * p3 - qy * p0 - qz * p1
        g_rotation[n, 3] = qw * p3 - qx * p2 + qy * p1 - qz * p0
        g0, g1, g2 = g_moved[n, 0], g_moved[n, 1], g_moved[n, 2]
        s0 = s1 = s2 = np.float32(0)
        for k in range(near.shape[1]):
            c, u = near[n, k], weight[n, k]
            w, x, y, z = turn[c, 0], turn[c, 1], turn[c, 2], turn[c, 3]
            a, b, d = xyz[n, 0] - rest[c, 0], xyz[n, 1] - rest[c, 1], xyz[n, 2] - rest[c, 2]
            sx, sy, sz = 2 * (z * g1 - y * g2), 2 * (x * g2 - z * g0), 2 * (y * g0 - x * g1)
            s0 += u * (g0 + w * sx - y * sz + z * sy)
            s1 += u * (g1 + w * sy - z * sx + x * sz)
            s2 += u * (g2 + w * sz - x * sy + y * sx)
            sums[c, 0] += u * g0
            sums[c, 1] += u * g1
            sums[c, 2] += u * g2
            ux, uy, uz = y * d - z * b, z * a - x * d, x * b - y * a
            va, ga, away = x * a + y * b + z * d, g0 * x + g1 * y + g2 * z, 2 * (g0 * a + g1 * b + g2 * d)
            sums[c, 3] += u * (2 * (g0 * ux + g1 * uy + g2 * uz) + bw)
            sums[c, 4] += u * (2 * (w * (b * g2 - d * g1) + g0 * va + a * ga - x * away) + bx)
            sums[c, 5] += u * (2 * (w * (d * g0 - a * g2) + g1 * va + b * ga - y * away) + by)
            sums[c, 6] += u * (2 * (w * (a * g1 - b * g0) + g2 * va + d * ga - z * away) + bz)
        g_xyz[n, 0], g_xyz[n, 1], g_xyz[n, 2] = s0, s1, s2
