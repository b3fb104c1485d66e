# SPDX-License-Identifier: GPL-3.0-or-later
"""The CPU backend's per-pixel half: blends tiles front to back, and walks them back to front for the gradients.

Within a tile a Gaussian visits just the rows, and on each row just the span of pixels, where its alpha reaches 1/255.
The way back recovers each transmittance by division.
"""

# ruff: noqa: I001 (few lines of constants, not twenty)
from __future__ import annotations

import math

import numpy as np

from ..constants import ALPHA_MAX, TRANSMITTANCE_MIN
from .jit import jit
from .layout import (
    BLUE, GREEN, INVERSE, LOG, LOG_ALPHA_MIN, MX, MY, REACH_X, REACH_Y, RED, SLOPE, SUMS, TILE, UX, UY, VY, float32,
)  # fmt: skip
from .simd import ROWS, bits, columns, exp2, fma, load, prefetch, rows, select, splat, store, store_totals, total

CELL, ACROSS = 8, TILE // 8  # a tile is ACROSS² cells of CELL² pixels, so that what is hidden costs one look
# A tile's state is planes of blocks of ROWS rows of pixels, whose rows take turns: see `_at`. A span may run up to
# seven pixels over the tile's right edge, into scratch.
PLANE = (TILE + 8) * ROWS
HALF, SLACK = float32(0.5), float32(1e-3)  # slack: rounding of a span's ends; the pixels decide exactly
HIGHEST, STOP, ZERO = float32(ALPHA_MAX), float32(TRANSMITTANCE_MIN), float32(0)
WIDE = 32  # from this width on (pixels, less one) each row finds its own span; at 8 it took a half longer than it saved
AHEAD = 8  # Gaussians: how far ahead memory is asked for


@jit
def _at(planes, x, y):
    """Where a state of so many planes has the pixel (x, y) of the tile in its first plane."""
    return y // ROWS * planes * PLANE + x * ROWS + y % ROWS


@jit
def _inside(centre, half, x0, n):
    """The pixels [a, b] of [x0, x0 + n) whose centres lie within `half` of `centre`; b may be one too many at the
    left edge. (No ceil or floor: they are library calls.)"""
    low, high = max(centre - half - HALF, float32(x0)), min(centre + half - HALF, float32(x0 + n - 1))
    a = int(low)
    return a + (float32(a) < low), (int(high) if high >= 0 else -1)


@jit
def _span(mx, my, slope, vy, log, inverse, y, last, x0, w):
    """The pixels [a, b] of [x0, x0 + w) that the block of rows from y on needs, the last one at most."""
    a, b = x0 + w, -1
    for k in range(ROWS):
        dy = float32(min(y + k, last)) + HALF - my
        v = vy * dy
        left = log - v * v - LOG_ALPHA_MIN
        low, high = _inside(mx - slope * dy, math.sqrt(max(left, ZERO)) * inverse + SLACK, x0, w)
        if left > -SLACK and low <= high:
            a, b = min(a, low), max(b, high)
    return a, b


@jit
def _refresh(state, live):
    """Marks the cells where every pixel has stopped; how many have not."""
    count = 0
    for cell in range(ACROSS * ACROSS):
        if live[cell]:
            at = _at(5, cell % ACROSS * CELL, cell // ACROSS * CELL)
            live[cell] = False
            for y in range(0, CELL, ROWS):
                live[cell] |= bits(load(state, at + y // ROWS * 5 * PLANE) > splat(ZERO)) != 0
            count += live[cell]
    return count


@jit
def _reaches(cells, least, a, b, top, bottom):
    """Whether any cell under the box of pixels (relative to the tile) has at least the value `least`."""
    for y in range(top // CELL, bottom // CELL + 1):
        for x in range(a // CELL, b // CELL + 1):
            if cells[y * ACROSS + x] >= least:
                return True
    return False


@jit
def _blend(P, pairs, first, last, x0, y0, w, h, state, live):
    """Blends one tile into state, planes T r g b index by block of rows. T < 0: stopped with |T| left."""
    state[:] = 0
    live[:] = 1
    for y in range(h):
        at = _at(5, 0, y)
        for x in range(w):
            state[at + x * ROWS] = 1
    zero, lowest, highest, stop = splat(float32(0)), splat(LOG_ALPHA_MIN), splat(HIGHEST), splat(STOP)
    for i in range(first, last):
        if (i - first) % 64 == 0 and _refresh(state, live) == 0:
            break
        if i + AHEAD < last:
            prefetch(P, pairs[i + AHEAD])
        r = pairs[i]
        mx, my, ux, uy, vy = P[r, MX], P[r, MY], P[r, UX], P[r, UY], P[r, VY]
        top, bottom = _inside(my, P[r, REACH_Y], y0, h)
        a, b = _inside(mx, P[r, REACH_X], x0, w)
        if not _reaches(live, 1, a - x0, b - x0, top - y0, bottom - y0):
            continue
        wide = b - a >= WIDE
        red, green, blue, log = splat(P[r, RED]), splat(P[r, GREEN]), splat(P[r, BLUE]), splat(P[r, LOG])
        index = splat(float32(i - first + 1))
        u0, v0 = fma(splat(ux), columns(), splat(uy) * rows()), splat(vy) * rows()
        for y in range(top - top % ROWS, bottom + 1, ROWS):
            if wide:
                a, b = _span(mx, my, P[r, SLOPE], vy, P[r, LOG], P[r, INVERSE], y, y0 + h - 1, x0, w)
            dy = float32(y) + HALF - my
            v = v0 + splat(vy * dy)
            k = fma(-v, v, log)
            row = _at(5, -x0, y - y0)
            for x in range(a, b + 1, 8):
                at = row + x * ROWS
                T = load(state, at)
                alive = zero < T
                if bits(alive) == 0:
                    continue
                u = u0 + splat(ux * (float32(x) + HALF - mx) + uy * dy)
                e = fma(-u, u, k)
                alpha = exp2(e)
                alpha = select(alpha > highest, highest, alpha)
                after = fma(-alpha, T, T)
                reached = e >= lowest
                go = reached & (after > stop)
                weight = select(go, alpha * T, zero)
                stopped = select(reached & alive, -T, T)
                store(state, at, select(go, after, stopped))
                at += PLANE
                store(state, at, fma(weight, red, load(state, at)))
                at += PLANE
                store(state, at, fma(weight, green, load(state, at)))
                at += PLANE
                store(state, at, fma(weight, blue, load(state, at)))
                at += PLANE
                store(state, at, select(go, index, load(state, at)))


@jit
def _unblend(P, pairs, slots, first, last, x0, y0, w, h, state, deep, sums):
    """Backward through one tile: state has planes T, B (the colour behind, dotted with the gradient, over its
    own transmittance), dL/dr, dL/dg, dL/db, index; deep: the highest index per cell. Writes the pairs' rows of
    sums, those of hidden pairs excepted. What stands before
    the sums is `_blend`'s, written out again: a function of both would hand back fourteen vectors to each step."""
    zero, one, lowest, highest = splat(float32(0)), splat(float32(1)), splat(LOG_ALPHA_MIN), splat(HIGHEST)
    flat = sums.reshape(-1)
    for i in range(last - 1, first - 1, -1):
        if i - AHEAD >= first:
            prefetch(P, pairs[i - AHEAD])
            prefetch(sums, slots[i - AHEAD])
        r = pairs[i]
        mx, my, ux, uy, vy = P[r, MX], P[r, MY], P[r, UX], P[r, UY], P[r, VY]
        top, bottom = _inside(my, P[r, REACH_Y], y0, h)
        a, b = _inside(mx, P[r, REACH_X], x0, w)
        if not _reaches(deep, i - first + 1, a - x0, b - x0, top - y0, bottom - y0):
            continue
        wide = b - a >= WIDE
        red, green, blue, log = splat(P[r, RED]), splat(P[r, GREEN]), splat(P[r, BLUE]), splat(P[r, LOG])
        index = splat(float32(i - first + 1))
        u0, v0 = fma(splat(ux), columns(), splat(uy) * rows()), splat(vy) * rows()
        s_red, s_green, s_blue, s_h, s_hu, s_hv = zero, zero, zero, zero, zero, zero
        s_huu, s_huv, s_hvv = zero, zero, zero
        for y in range(top - top % ROWS, bottom + 1, ROWS):
            if wide:
                a, b = _span(mx, my, P[r, SLOPE], vy, P[r, LOG], P[r, INVERSE], y, y0 + h - 1, x0, w)
            dy = float32(y) + HALF - my
            v = v0 + splat(vy * dy)
            k = fma(-v, v, log)
            row = _at(6, -x0, y - y0)
            for x in range(a, b + 1, 8):
                at = row + x * ROWS
                seen = load(state, at + 5 * PLANE) >= index
                if bits(seen) == 0:
                    continue
                u = u0 + splat(ux * (float32(x) + HALF - mx) + uy * dy)
                e = fma(-u, u, k)
                raw = exp2(e)
                alpha = select((e >= lowest) & seen, select(raw > highest, highest, raw), zero)
                T, B = load(state, at) / (one - alpha), load(state, at + PLANE)
                g_red, g_green = load(state, at + 2 * PLANE), load(state, at + 3 * PLANE)
                g_blue = load(state, at + 4 * PLANE)
                weight = alpha * T
                d = fma(red, g_red, fma(green, g_green, fma(blue, g_blue, -B)))
                store(state, at, T)
                store(state, at + PLANE, fma(alpha, d, B))
                s_red, s_green = fma(weight, g_red, s_red), fma(weight, g_green, s_green)
                s_blue = fma(weight, g_blue, s_blue)
                g = select(highest >= raw, weight * d, zero)  # dL/d(ln alpha); the clamp stops it
                gu, gv = g * u, g * v
                s_h, s_hu, s_hv = s_h + g, s_hu + gu, s_hv + gv
                s_huu, s_huv, s_hvv = fma(gu, u, s_huu), fma(gu, v, s_huv), fma(gv, v, s_hvv)
        at = slots[i] * SUMS
        store_totals(flat, at, s_red, s_green, s_blue, s_h, s_hu, s_hv, s_huu, s_huv)
        flat[at + 8] = total(s_hvv)


@jit
def blend_tiles(tiles, P, starts, pairs, background, image, alpha, kept):
    """Renders the tiles tiles[0] <= j < tiles[1] of one view, whose P, starts and pairs are those of `project_view`,
    over background (3,) into image (H,W,3) and alpha (H,W). kept (tiles, TILE // ROWS, 2, PLANE): per tile, the planes
    of what the transmittance ends at and of the last one drawn, from 1."""
    height, width = alpha.shape
    across = (width + TILE - 1) // TILE
    state, live = np.empty(TILE // ROWS * 5 * PLANE, np.float32), np.empty(ACROSS * ACROSS, np.uint8)
    red, green, blue = background[0], background[1], background[2]
    for j in range(tiles[0], tiles[1]):
        x0, y0 = j % across * TILE, j // across * TILE
        w, h = min(TILE, width - x0), min(TILE, height - y0)
        _blend(P, pairs, starts[j], starts[j + 1], x0, y0, w, h, state, live)
        for y in range(h):
            at = _at(5, 0, y)
            for x in range(w):
                T = abs(state[at])
                alpha[y0 + y, x0 + x] = float32(1) - T
                image[y0 + y, x0 + x, 0] = state[at + PLANE] + T * red
                image[y0 + y, x0 + x, 1] = state[at + 2 * PLANE] + T * green
                image[y0 + y, x0 + x, 2] = state[at + 3 * PLANE] + T * blue
                at += ROWS
        for y in range((h + ROWS - 1) // ROWS):
            for x in range(PLANE):
                kept[j, y, 0, x] = abs(state[y * 5 * PLANE + x])
                kept[j, y, 1, x] = state[(y * 5 + 4) * PLANE + x]


@jit
def unblend_tiles(tiles, P, starts, pairs, slots, background, g_image, g_alpha, kept, sums):
    """Backward through the tiles of one view: from g_image (H,W,3), g_alpha (H,W) and what `blend_tiles` kept to the
    rows of sums (pairs, SUMS)."""
    height, width = g_alpha.shape
    across = (width + TILE - 1) // TILE
    state, deep = np.zeros(TILE // ROWS * 6 * PLANE, np.float32), np.empty(ACROSS * ACROSS, np.float32)
    red, green, blue = background[0], background[1], background[2]
    for j in range(tiles[0], tiles[1]):
        x0, y0 = j % across * TILE, j // across * TILE
        w, h = min(TILE, width - x0), min(TILE, height - y0)
        deep[:] = 0
        for y in range((h + ROWS - 1) // ROWS):
            for x in range(PLANE):
                state[y * 6 * PLANE + x] = kept[j, y, 0, x]
                state[(y * 6 + 5) * PLANE + x] = kept[j, y, 1, x]
            for x in range(w):
                cell = y * ROWS // CELL * ACROSS + x // CELL
                for k in range(ROWS):
                    deep[cell] = max(deep[cell], kept[j, y, 1, x * ROWS + k])
        for y in range(h):
            at = _at(6, 0, y)
            for x in range(w):
                r, g, b = g_image[y0 + y, x0 + x, 0], g_image[y0 + y, x0 + x, 1], g_image[y0 + y, x0 + x, 2]
                state[at + PLANE] = r * red + g * green + b * blue - g_alpha[y0 + y, x0 + x]
                state[at + 2 * PLANE], state[at + 3 * PLANE], state[at + 4 * PLANE] = r, g, b
                at += ROWS
        used = starts[j] + int(deep.max())
        _unblend(P, pairs, slots, starts[j], used, x0, y0, w, h, state, deep, sums)
