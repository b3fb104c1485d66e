# SPDX-License-Identifier: GPL-3.0-or-later
"""Which tiles a projected Gaussian reaches, exactly: a tile is entered only where the ellipse does (Speedy-Splat's
AccuTile); and the lists of the tiles, front to back."""

from __future__ import annotations

import math

import numpy as np

from .jit import jit
from .layout import DEPTH, INVERSE, LOG, LOG_ALPHA_MIN, MX, MY, REACH_X, REACH_Y, SLOPE, TILE, TILT, VY


@jit
def _order(P):
    """The rows of P by depth: a radix sort of the floats' bits (which sort as positive floats do), three stable passes
    of 11 bits, so equal depths stay in the order of the input."""
    m = len(P)
    a, ka = np.empty(m, np.int32), np.empty(m, np.float32)
    for i in range(m):
        a[i], ka[i] = i, P[i, DEPTH]
    ka = ka.view(np.uint32)
    b, kb = np.empty_like(a), np.empty_like(ka)
    at = np.zeros((3, 2049), np.int64)
    for i in range(m):
        for digit in range(3):
            at[digit, ((ka[i] >> np.uint32(11 * digit)) & np.uint32(2047)) + 1] += 1
    for digit in range(3):
        shift = np.uint32(11 * digit)
        if m and at[digit, ((ka[0] >> shift) & np.uint32(2047)) + 1] == m:
            continue  # the same in all
        for i in range(2048):
            at[digit, i + 1] += at[digit, i]
        for i in range(m):
            d = (ka[i] >> shift) & np.uint32(2047)
            b[at[digit, d]], kb[at[digit, d]] = a[i], ka[i]
            at[digit, d] += 1
        a, b, ka, kb = b, a, kb, ka
    return a


@jit
def _tiles(low, high, n):
    """First and last tile of n pixels that [low, high] touches; it touches one."""
    return int(max(low, 0.0)) // TILE, int(min(high, n - 1.0)) // TILE


@jit
def bin_rows(P, width, height):
    """-> starts (tiles + 1), pairs, slots, first (rows + 1): tile j is reached by the rows pairs[starts[j] :
    starts[j + 1]] of P, front to back. Every pair has a slot of its own (slots, like pairs), which for row r are
    first[r] to first[r + 1]. Per row of tiles the exact extent of the ellipse in that band counts, not its box."""
    across, down = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    bound, n = 0, 0  # by boxes; an array that grew in the loop would cost reference counts on every turn
    for r in range(len(P)):
        left, right = _tiles(P[r, MX] - P[r, REACH_X], P[r, MX] + P[r, REACH_X], width)
        top, bottom = _tiles(P[r, MY] - P[r, REACH_Y], P[r, MY] + P[r, REACH_Y], height)
        bound += (right - left + 2) * (bottom - top + 2)
    tile, first = np.empty(bound, np.int32), np.empty(len(P) + 1, np.int32)
    starts = np.zeros(across * down + 1, np.int64)
    for r in range(len(P)):
        first[r] = n
        rx, ry = np.float64(P[r, REACH_X]), np.float64(P[r, REACH_Y])
        mx, my = np.float64(P[r, MX]), np.float64(P[r, MY])
        top, bottom = _tiles(my - ry, my + ry, height)
        left, right = mx - rx, mx + rx
        for ty in range(top, bottom + 1):
            if rx > TILE // 2:
                low, high = max(ty * TILE - my, -ry), min(ty * TILE + TILE - my, ry)
                a, b = min(max(-P[r, TILT], low), high), min(max(P[r, TILT], low), high)
                s, vy = P[r, LOG] - LOG_ALPHA_MIN, P[r, VY]
                left = mx - P[r, SLOPE] * a - math.sqrt(max(s - (vy * a) ** 2, 0.0)) * P[r, INVERSE] - 0.01
                right = mx - P[r, SLOPE] * b + math.sqrt(max(s - (vy * b) ** 2, 0.0)) * P[r, INVERSE] + 0.01
                if right < 0 or left > width:
                    continue
            left_tile, right_tile = _tiles(left, right, width)
            for tx in range(left_tile, right_tile + 1):
                tile[n] = ty * across + tx
                starts[tile[n] + 1] += 1
                n += 1
    first[len(P)] = n
    for j in range(across * down):
        starts[j + 1] += starts[j]
    pairs, slots, at = np.empty(n, np.int32), np.empty(n, np.int32), starts.copy()
    order = _order(P)
    for i in range(len(P)):
        r = order[i]
        for slot in range(first[r], first[r + 1]):
            j = tile[slot]
            pairs[at[j]], slots[at[j]] = r, slot
            at[j] += 1
    return starts, pairs, slots, first
