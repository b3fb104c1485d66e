# SPDX-License-Identifier: GPL-3.0-or-later
"""What control points do at a moment, and how far they bend what they hold, with gradients. One compiled pass each: in
torch's single operations these took two thirds of a step of a fit, the rasteriser an eighth."""

from __future__ import annotations

import numba
import numpy as np
import torch
from torch import Tensor


class Pose(torch.autograd.Function):
    """moments (K,) int32 and share (K,), which moments of a motion table count now, and how much; index (C,S) int32
    and weight (C,S), which of the table's places move a control point; rest (C,3): without gradients. values (M,P,6)
    -> place (C,3), rest plus what the places do, and unit turn (C,4), (1, half the sum of their axes) normalised;
    float32 on the CPU."""

    @staticmethod
    def forward(ctx, moments, share, index, weight, rest, values):
        ctx.inputs = [x.detach().contiguous().numpy() for x in (moments, share, index, weight)]
        place, ctx.turn = np.empty((len(rest), 3), np.float32), np.empty((len(rest), 4), np.float32)
        ctx.shape = values.shape
        _pose(*ctx.inputs, rest.numpy(), values.detach().numpy(), place, ctx.turn)
        return torch.from_numpy(place), torch.from_numpy(ctx.turn)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, g_place: Tensor, g_turn: Tensor):
        g_values = torch.zeros(ctx.shape)
        told = g_place.contiguous().numpy(), g_turn.contiguous().numpy()
        _pose_back(*ctx.inputs, ctx.turn, *told, g_values.numpy())
        return None, None, None, None, None, g_values


class Bending(torch.autograd.Function):
    """neighbours (C,J) of control points at rest (C,3): without gradients. place (C,3), turn (C,4) unit quaternions
    -> () the mean square of how far neighbours are from where each would carry them if it were rigid."""

    @staticmethod
    def forward(ctx, neighbours, rest, place, turn):
        g_place, g_turn = np.zeros(place.shape, np.float32), np.zeros(turn.shape, np.float32)
        inputs = (x.detach().contiguous().numpy() for x in (neighbours, rest, place, turn))
        value = _bending(*inputs, g_place, g_turn)
        ctx.gradients = torch.from_numpy(g_place), torch.from_numpy(g_turn)
        return place.new_tensor(value)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, g: Tensor):
        return None, None, *(g * x for x in ctx.gradients)


@numba.njit(cache=True, nogil=True, fastmath=True)
def _pose(moments, share, index, weight, rest, values, place, turn):
    now = np.zeros(values.shape[1:], np.float32)
    for m, u in zip(moments, share):  # noqa: B905 (numba knows no strict)
        now += u * values[m]
    done = np.empty(6, np.float32)
    for c in range(len(rest)):
        done[:] = 0
        for s in range(index.shape[1]):
            for i in range(6):
                done[i] += weight[c, s] * now[index[c, s], i]
        for i in range(3):
            place[c, i] = rest[c, i] + done[i]
        x, y, z = done[3] / 2, done[4] / 2, done[5] / 2
        unit = np.float32(1 / np.sqrt(1 + x * x + y * y + z * z))
        turn[c, 0], turn[c, 1], turn[c, 2], turn[c, 3] = unit, x * unit, y * unit, z * unit


@numba.njit(cache=True, nogil=True, fastmath=True)
def _pose_back(moments, share, index, weight, turn, g_place, g_turn, g_values):
    now = np.zeros(g_values.shape[1:], np.float32)
    g = np.empty(6, np.float32)
    for c in range(len(turn)):
        along = np.float32(0)
        for i in range(4):
            along += turn[c, i] * g_turn[c, i]
        for i in range(3):
            g[i] = g_place[c, i]
            g[3 + i] = turn[c, 0] * (g_turn[c, 1 + i] - turn[c, 1 + i] * along) / 2
        for s in range(index.shape[1]):
            for i in range(6):
                now[index[c, s], i] += weight[c, s] * g[i]
    for m, u in zip(moments, share):  # noqa: B905
        g_values[m] = u * now


@numba.njit(cache=True, nogil=True, fastmath=True)
def _bending(neighbours, rest, place, turn, g_place, g_turn):
    total = 0.0
    scale = np.float32(2 / neighbours.size)
    for c in range(len(rest)):
        w, x, y, z = turn[c]
        for n in neighbours[c]:
            a, b, d = rest[n, 0] - rest[c, 0], rest[n, 1] - rest[c, 1], rest[n, 2] - rest[c, 2]
            sx, sy, sz = 2 * (y * d - z * b), 2 * (z * a - x * d), 2 * (x * b - y * a)
            e0 = place[n, 0] - place[c, 0] - (a + w * sx + y * sz - z * sy)
            e1 = place[n, 1] - place[c, 1] - (b + w * sy + z * sx - x * sz)
            e2 = place[n, 2] - place[c, 2] - (d + w * sz + x * sy - y * sx)
            total += e0 * e0 + e1 * e1 + e2 * e2
            g0, g1, g2 = scale * e0, scale * e1, scale * e2
            g_place[n, 0] += g0
            g_place[n, 1] += g1
            g_place[n, 2] += g2
            g_place[c, 0] -= g0
            g_place[c, 1] -= g1
            g_place[c, 2] -= g2
            va, ga, away = x * a + y * b + z * d, g0 * x + g1 * y + g2 * z, 2 * (g0 * a + g1 * b + g2 * d)
            g_turn[c, 0] -= g0 * sx + g1 * sy + g2 * sz
            g_turn[c, 1] -= 2 * (w * (b * g2 - d * g1) + g0 * va + a * ga - x * away)
            g_turn[c, 2] -= 2 * (w * (d * g0 - a * g2) + g1 * va + b * ga - y * away)
            g_turn[c, 3] -= 2 * (w * (a * g1 - b * g0) + g2 * va + d * ga - z * away)
    return total / neighbours.size
