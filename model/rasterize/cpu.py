# SPDX-License-Identifier: GPL-3.0-or-later
"""The CPU backend: compiled by numba, parallel over views and tiles, eight pixels at a time.

Per view: cull by time, opacity and depth; radix-sort the survivors by depth; project them in that order; bin
them into tiles (exactly: a tile is entered only where the ellipse reaches it, Speedy-Splat's AccuTile); blend
every tile front to back. Within a tile a Gaussian visits just the rows, and on each row just the span of
pixels, where its alpha reaches 1/255. The backward pass walks the tile lists back to front and recovers each
transmittance by division. Every (tile, Gaussian) pair owns one row of a gradient buffer, which is then summed
in a fixed order: no atomics, and the same bits on every run and for any number of threads.
"""

# ruff: noqa: I001 (one line of constants, not twenty)
from __future__ import annotations

import itertools
import math

import numpy as np
import torch

from ..threads import each
from . import ALPHA_MAX, T_STOP, project
from .project import (
    BLUE, E_MIN, F32, GREEN, HU, HUU, HUV, HV, HVV, INVERSE, LOG, MX, MY, REACH_X, REACH_Y, RED, SLOPE, SUMS, TILE,
    UX, UY, VY, H, serial,
)  # fmt: skip
from .simd import any_lane, exp2, fma, load, ramp, select, splat, store, total

CELL, ACROSS = 8, TILE // 8  # a tile is ACROSS² cells of CELL² pixels, so that what is hidden costs one look
STRIDE = TILE + 8  # a span may run up to seven pixels over the tile's right edge, into scratch
HALF, SLACK = F32(0.5), F32(1e-3)  # slack: rounding of a span's ends; the pixels decide exactly
HIGHEST, STOP, ZERO = F32(ALPHA_MAX), F32(T_STOP), F32(0)
WIDE = 8  # from this width on (pixels, less one) each row finds its own span; below, the box is one step anyway


@serial
def _inside(centre, half, x0, n):
    """The pixels [a, b] of [x0, x0 + n) whose centres lie within `half` of `centre`; b may be one too many at the
    left edge. (No ceil or floor: they are library calls.)"""
    low, high = max(centre - half - HALF, F32(x0)), min(centre + half - HALF, F32(x0 + n - 1))
    a = int(low)
    return a + (F32(a) < low), (int(high) if high >= 0 else -1)


@serial
def _refresh(state, live):
    """Marks the cells where every pixel has stopped; how many have not."""
    count = 0
    for cell in range(ACROSS * ACROSS):
        if live[cell]:
            at = cell // ACROSS * CELL * 5 * STRIDE + cell % ACROSS * CELL
            live[cell] = False
            for y in range(CELL):
                live[cell] |= any_lane(load(state, at + y * 5 * STRIDE) > splat(ZERO))
            count += live[cell]
    return count


@serial
def _reaches(cells, least, a, b, top, bottom):
    """Whether any cell under the box of pixels (relative to the tile) has at least the value `least`."""
    for y in range(top // CELL, bottom // CELL + 1):
        for x in range(a // CELL, b // CELL + 1):
            if cells[y * ACROSS + x] >= least:
                return True
    return False


@serial
def _blend(P, pairs, first, last, x0, y0, w, h, state, live):
    """Blends one tile into state, planes T r g b index by row of pixels. T < 0: stopped with |T| left."""
    state[:] = 0
    live[:] = 1
    for y in range(h):
        for x in range(w):
            state[y * 5 * STRIDE + x] = 1
    zero, lowest, highest, stop = splat(F32(0)), splat(E_MIN), splat(HIGHEST), splat(STOP)
    for i in range(first, last):
        if (i - first) % 64 == 0 and _refresh(state, live) == 0:
            break
        r = pairs[i]
        ux, red, green, blue = splat(P[r, UX]), splat(P[r, RED]), splat(P[r, GREEN]), splat(P[r, BLUE])
        index = splat(F32(i - first + 1))
        mx, my, uy, vy, log = P[r, MX], P[r, MY], P[r, UY], P[r, VY], P[r, LOG]
        inverse, slope = P[r, INVERSE], P[r, SLOPE]
        top, bottom = _inside(my, P[r, REACH_Y], y0, h)
        a, b = _inside(mx, P[r, REACH_X], x0, w)
        if not _reaches(live, 1, a - x0, b - x0, top - y0, bottom - y0):
            continue
        wide = b - a >= WIDE
        for y in range(top, bottom + 1):
            dy = F32(y) + HALF - my
            v = vy * dy
            k = log - v * v
            if wide:
                a, b = _inside(mx - slope * dy, math.sqrt(max(k - E_MIN, ZERO)) * inverse + SLACK, x0, w)
            row = (y - y0) * 5 * STRIDE - x0
            for x in range(a, b + 1, 8):
                at = row + x
                T = load(state, at)
                if not any_lane(zero < T):
                    continue
                u = fma(ux, ramp() + splat(F32(x) + HALF - mx), splat(uy * dy))
                e = fma(-u, u, splat(k))
                alpha = exp2(e)
                alpha = select(alpha > highest, highest, alpha)
                after = fma(-alpha, T, T)
                reached = e >= lowest
                go = reached & (after > stop)
                weight = select(go, alpha * T, zero)
                stopped = select(reached & (zero < T), -T, T)
                store(state, at, select(go, after, stopped))
                at += STRIDE
                store(state, at, fma(weight, red, load(state, at)))
                at += STRIDE
                store(state, at, fma(weight, green, load(state, at)))
                at += STRIDE
                store(state, at, fma(weight, blue, load(state, at)))
                at += STRIDE
                store(state, at, select(go, index, load(state, at)))


@serial
def _unblend(P, pairs, first, last, x0, y0, w, h, state, deep, sums):
    """Backward through one tile: state has planes T, B (the colour behind, dotted with the gradient, over its
    own transmittance), dL/dr, dL/dg, dL/db, index; deep: the highest index per cell. Writes the rows
    [first, last) of sums."""
    zero, one, lowest, highest = splat(F32(0)), splat(F32(1)), splat(E_MIN), splat(HIGHEST)
    for i in range(last - 1, first - 1, -1):
        r = pairs[i]
        ux, red, green, blue = splat(P[r, UX]), splat(P[r, RED]), splat(P[r, GREEN]), splat(P[r, BLUE])
        index = splat(F32(i - first + 1))
        s_red, s_green, s_blue, s_h, s_hu, s_hv = zero, zero, zero, zero, zero, zero
        s_huu, s_huv, s_hvv = zero, zero, zero
        mx, my, uy, vy, log = P[r, MX], P[r, MY], P[r, UY], P[r, VY], P[r, LOG]
        inverse, slope = P[r, INVERSE], P[r, SLOPE]
        top, bottom = _inside(my, P[r, REACH_Y], y0, h)
        a, b = _inside(mx, P[r, REACH_X], x0, w)
        if not _reaches(deep, i - first + 1, a - x0, b - x0, top - y0, bottom - y0):
            sums[i] = 0
            continue
        wide = b - a >= WIDE
        for y in range(top, bottom + 1):
            dy = F32(y) + HALF - my
            v = vy * dy
            k = log - v * v
            if wide:
                a, b = _inside(mx - slope * dy, math.sqrt(max(k - E_MIN, ZERO)) * inverse + SLACK, x0, w)
            row = (y - y0) * 6 * STRIDE - x0
            for x in range(a, b + 1, 8):
                at = row + x
                seen = load(state, at + 5 * STRIDE) >= index
                if not any_lane(seen):
                    continue
                u = fma(ux, ramp() + splat(F32(x) + HALF - mx), splat(uy * dy))
                e = fma(-u, u, splat(k))
                raw = exp2(e)
                alpha = select((e >= lowest) & seen, select(raw > highest, highest, raw), zero)
                T, B = load(state, at) / (one - alpha), load(state, at + STRIDE)
                g_red, g_green = load(state, at + 2 * STRIDE), load(state, at + 3 * STRIDE)
                g_blue = load(state, at + 4 * STRIDE)
                weight = alpha * T
                d = fma(red, g_red, fma(green, g_green, fma(blue, g_blue, -B)))
                store(state, at, T)
                store(state, at + STRIDE, fma(alpha, d, B))
                s_red, s_green = fma(weight, g_red, s_red), fma(weight, g_green, s_green)
                s_blue = fma(weight, g_blue, s_blue)
                g = select(highest >= raw, weight * d, zero)  # dL/d(ln alpha); the clamp stops it
                gu, gv, vv = g * u, g * splat(v), splat(v)
                s_h, s_hu, s_hv = s_h + g, s_hu + gu, s_hv + gv
                s_huu, s_huv, s_hvv = fma(gu, u, s_huu), fma(gu, vv, s_huv), fma(gv, vv, s_hvv)
        sums[i, 0], sums[i, 1], sums[i, 2] = total(s_red), total(s_green), total(s_blue)
        sums[i, H], sums[i, HU], sums[i, HV] = total(s_h), total(s_hu), total(s_hv)
        sums[i, HUU], sums[i, HUV], sums[i, HVV] = total(s_huu), total(s_huv), total(s_hvv)


@serial
def _blend_tiles(tiles, P, starts, pairs, background, image, alpha, left, index):
    """Renders the tiles of one view; left: what the transmittance ends at; index: the last one drawn, from 1."""
    height, width = alpha.shape
    across = (width + TILE - 1) // TILE
    state, live = np.empty(TILE * 5 * STRIDE, np.float32), np.empty(ACROSS * ACROSS, np.uint8)
    for j in range(tiles[0], tiles[1]):
        x0, y0 = j % across * TILE, j // across * TILE
        w, h = min(TILE, width - x0), min(TILE, height - y0)
        _blend(P, pairs, starts[j], starts[j + 1], x0, y0, w, h, state, live)
        for y in range(h):
            for x in range(w):
                at = y * 5 * STRIDE + x
                T = abs(state[at])
                left[y0 + y, x0 + x], alpha[y0 + y, x0 + x] = T, F32(1) - T
                index[y0 + y, x0 + x] = state[at + 4 * STRIDE]
                for k in range(3):
                    image[y0 + y, x0 + x, k] = state[at + (k + 1) * STRIDE] + T * background[k]


@serial
def _unblend_tiles(tiles, P, starts, pairs, background, g_image, g_alpha, left, index, used, sums):
    """Backward through the tiles of one view: the rows [starts[j], used[j]) of sums."""
    height, width = left.shape
    across = (width + TILE - 1) // TILE
    state, deep = np.zeros(TILE * 6 * STRIDE, np.float32), np.empty(ACROSS * ACROSS, np.int64)
    for j in range(tiles[0], tiles[1]):
        x0, y0 = j % across * TILE, j // across * TILE
        w, h = min(TILE, width - x0), min(TILE, height - y0)
        deep[:] = 0
        for y in range(h):
            for x in range(w):
                at = y * 6 * STRIDE + x
                behind = -g_alpha[y0 + y, x0 + x]
                for k in range(3):
                    g = g_image[y0 + y, x0 + x, k]
                    state[at + (2 + k) * STRIDE] = g
                    behind += g * background[k]
                state[at], state[at + STRIDE] = left[y0 + y, x0 + x], behind
                state[at + 5 * STRIDE] = index[y0 + y, x0 + x]
                cell = y // CELL * ACROSS + x // CELL
                deep[cell] = max(deep[cell], int(index[y0 + y, x0 + x]))
        used[j] = starts[j] + deep.max()
        _unblend(P, pairs, starts[j], used[j], x0, y0, w, h, state, deep, sums)


@serial
def _add_tiles(rows, starts, used, pairs, sums):
    """-> (rows, SUMS): the tiles' gradients of every Gaussian of a view added up, tile after tile."""
    S = np.zeros((rows, SUMS), np.float32)
    for j in range(len(used)):
        for i in range(starts[j], used[j]):
            r = pairs[i]
            for k in range(SUMS):
                S[r, k] += sums[i, k]
    return S


def _bands(width, height):
    """Jobs within a view: rows of tiles, as (first, last) tile."""
    across, down = -(-width // TILE), -(-height // TILE)
    return [(k * across, k * across + across) for k in range(down)]


def _arrays(tensors, dtype=torch.float32):
    return tuple(x.detach().to(dtype).contiguous().numpy() for x in tensors)


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx, *args):
        cameras, (size, background, inference) = args[7:10], args[10:]
        ctx.save_for_backward(*args[:7])  # so that torch notices if they are changed in place before backward
        inputs = _arrays(args[:7])
        cameras = _arrays(cameras, torch.float64)
        (background,) = _arrays([background])
        (width, height), views = size, len(cameras[0])
        shape = (views, height, width)
        image, alpha, left, index = (np.empty(s, np.float32) for s in ((*shape, 3), shape, shape, shape))
        rows = each(
            [(c,) for c in range(views)],
            lambda c: project.project_view(c, *inputs, *cameras, width, height, inference),
        )  # per view: ids, P, starts, pairs

        def blend(c, band):
            _blend_tiles(band, *rows[c][1:], background, image[c], alpha[c], left[c], index[c])

        each(itertools.product(range(views), _bands(width, height)), blend)
        ctx.saved = cameras, background, rows, left, index
        return torch.from_numpy(image).to(args[0].dtype), torch.from_numpy(alpha).to(args[0].dtype)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *grads):
        inputs, (cameras, background, rows, left, index) = _arrays(ctx.saved_tensors), ctx.saved
        g_image, g_alpha = _arrays(grads)
        views, height, width = left.shape
        used = [np.zeros(len(starts) - 1, np.int64) for _, _, starts, _ in rows]
        sums = [np.empty((len(pairs), SUMS), np.float32) for _, _, _, pairs in rows]

        def unblend(c, band):
            _unblend_tiles(band, *rows[c][1:], background, g_image[c], g_alpha[c], left[c], index[c], used[c], sums[c])

        each(itertools.product(range(views), _bands(width, height)), unblend)
        added = each(
            [(c,) for c in range(views)],
            lambda c: _add_tiles(len(rows[c][0]), rows[c][2], used[c], rows[c][3], sums[c]),
        )
        out = tuple(np.zeros_like(x) for x in inputs)
        count, parts = len(inputs[0]), torch.get_num_threads()

        def chain(part):  # every Gaussian has one owner, who adds the views in their order
            own = part * count // parts, (part + 1) * count // parts
            for c in range(views):
                project.chain(c, own, rows[c][0], rows[c][1], added[c], *inputs, *cameras, width, height, out)

        each([(k,) for k in range(parts)], chain)
        return *(torch.from_numpy(x).to(y.dtype) for x, y in zip(out, ctx.saved_tensors, strict=True)), *([None] * 6)


def rasterize(*args):
    """See `timesplat.model.rasterize.rasterize`; after the cameras: (width, height), background (3,), inference."""
    return _Rasterize.apply(*args)
