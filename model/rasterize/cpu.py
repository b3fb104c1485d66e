# SPDX-License-Identifier: GPL-3.0-or-later
"""The CPU backend: compiled by numba, parallel over views and tiles, eight pixels at a time.

Per view: cull by time, opacity and depth; radix-sort the survivors by depth; project them in that order; bin
them into tiles (exactly: a tile is entered only where the ellipse reaches it, Speedy-Splat's AccuTile); blend
every tile front to back. Within a tile a Gaussian visits just the rows, and on each row just the span of
pixels, where its alpha reaches 1/255. The backward pass walks the tile lists back to front and recovers each
transmittance by division. Every (tile, Gaussian) pair owns one row of a gradient buffer, which is then summed
in a fixed order: no atomics, and the same bits on every run and for any number of threads.
"""

from __future__ import annotations

import math
import threading

import numpy as np
import torch
from numba import njit, prange

from .simd import any_lane, exp2, fma, load, ramp, select, splat, store, total

TILE = 32  # pixels; measured best of 16, 32, 64 for 64² to 256² images
STRIDE = TILE + 8  # a span may run up to seven pixels over the tile's right edge, into scratch
CHUNK = 2048  # Gaussians per parallel job
F32 = np.float32
HALF, SLACK = F32(0.5), F32(1e-3)  # slack: rounding of a span's ends; the pixels decide exactly
LOG2E = math.log2(math.e)
ALPHA_MIN = 1 / 255
ALPHA_MAX = F32(0.999)
T_STOP = F32(1e-4)
E_MIN = F32(math.log2(ALPHA_MIN))
NEAR, BLUR, MARGIN = 0.01, 0.3, 0.3
FILTER = 0.05  # the paper's inference filters, appendix A.2

_options = {"cache": True, "nogil": True, "error_model": "numpy"}
_serial = njit(**_options)
_parallel = njit(parallel=True, **_options)
_lock = threading.Lock()  # numba's thread pools must not be entered by two threads at once

# One row per surviving Gaussian and view, in depth order. (u, v) = L d whitens the pixel offset d = (dx, dy),
# L = [[UX, UY], [0, VY]], scaled so that alpha = 2^(LOG - u² - v²).
# REACH: half sides of the box where alpha >= 1/255 (x: -1 outside the image); TILT: dy of its rightmost point.
MX, MY, UX, UY, VY, LOG, RED, GREEN, BLUE, REACH_X, REACH_Y, TILT = range(12)
PARAMS = 16
# Sums over pixels for one (tile, Gaussian) pair: d/d(r, g, b) and of h = dL/d(ln alpha) the moments.
H, HU, HV, HUU, HUV, HVV = range(3, 9)
SUMS = 9


@_serial
def _project(n, c, xyz, t, velocity, cov, c2w, intrinsics, time, width, height):
    """Camera-space centre, clamped slopes, M = J W (2×3), 2D covariance; float64 throughout."""
    dt = time[c] - t[n]
    x = xyz[n, 0] + velocity[n, 0] * dt - c2w[c, 0, 3]
    y = xyz[n, 1] + velocity[n, 1] * dt - c2w[c, 1, 3]
    z = xyz[n, 2] + velocity[n, 2] * dt - c2w[c, 2, 3]
    px = c2w[c, 0, 0] * x + c2w[c, 1, 0] * y + c2w[c, 2, 0] * z
    py = c2w[c, 0, 1] * x + c2w[c, 1, 1] * y + c2w[c, 2, 1] * z
    pz = c2w[c, 0, 2] * x + c2w[c, 1, 2] * y + c2w[c, 2, 2] * z
    fx, fy, cx, cy = intrinsics[c, 0], intrinsics[c, 1], intrinsics[c, 2], intrinsics[c, 3]
    rz = 1 / pz
    mx, my = MARGIN * 0.5 * width / fx, MARGIN * 0.5 * height / fy
    sx = min(max(px * rz, -cx / fx - mx), (width - cx) / fx + mx)
    sy = min(max(py * rz, -cy / fy - my), (height - cy) / fy + my)
    jx, jy = fx * rz, fy * rz
    m00 = jx * (c2w[c, 0, 0] - sx * c2w[c, 0, 2])
    m01 = jx * (c2w[c, 1, 0] - sx * c2w[c, 1, 2])
    m02 = jx * (c2w[c, 2, 0] - sx * c2w[c, 2, 2])
    m10 = jy * (c2w[c, 0, 1] - sy * c2w[c, 0, 2])
    m11 = jy * (c2w[c, 1, 1] - sy * c2w[c, 1, 2])
    m12 = jy * (c2w[c, 2, 1] - sy * c2w[c, 2, 2])
    c00, c11, c22 = np.float64(cov[n, 0, 0]), np.float64(cov[n, 1, 1]), np.float64(cov[n, 2, 2])
    c01 = 0.5 * (np.float64(cov[n, 0, 1]) + cov[n, 1, 0])
    c02 = 0.5 * (np.float64(cov[n, 0, 2]) + cov[n, 2, 0])
    c12 = 0.5 * (np.float64(cov[n, 1, 2]) + cov[n, 2, 1])
    # rows of M Σ: the backward pass needs them too
    a0, a1, a2 = (
        m00 * c00 + m01 * c01 + m02 * c02,
        m00 * c01 + m01 * c11 + m02 * c12,
        m00 * c02 + m01 * c12 + m02 * c22,
    )
    b0, b1, b2 = (
        m10 * c00 + m11 * c01 + m12 * c02,
        m10 * c01 + m11 * c11 + m12 * c12,
        m10 * c02 + m11 * c12 + m12 * c22,
    )
    sxx = a0 * m00 + a1 * m01 + a2 * m02 + BLUR
    sxy = a0 * m10 + a1 * m11 + a2 * m12
    syy = b0 * m10 + b1 * m11 + b2 * m12 + BLUR
    return (dt, px, py, pz, sx, sy), (m00, m01, m02, m10, m11, m12), (a0, a1, a2, b0, b1, b2), (sxx, sxy, syy)


@_serial
def _cull(c, lo, hi, xyz, t, velocity, sigma_t, opacity, c2w, time, inference, ids, keys):
    """Writes the ids and depth keys of the Gaussians [lo, hi) that may be seen from view c; how many."""
    zx, zy, zz = c2w[c, 0, 2], c2w[c, 1, 2], c2w[c, 2, 2]
    count = lo
    for n in range(lo, hi):
        dt = time[c] - t[n]
        e = 0.5 * (dt / sigma_t[n]) ** 2
        o = np.float64(opacity[n])
        if e > 5.55 + max(o - 1, 0.0):  # > ln(255 o)
            continue
        marginal = math.exp(-e)
        if o * marginal < ALPHA_MIN or (inference and (marginal < FILTER or o * marginal < FILTER)):
            continue
        z = (
            zx * (xyz[n, 0] + velocity[n, 0] * dt - c2w[c, 0, 3])
            + zy * (xyz[n, 1] + velocity[n, 1] * dt - c2w[c, 1, 3])
            + zz * (xyz[n, 2] + velocity[n, 2] * dt - c2w[c, 2, 3])
        )
        if z >= NEAR:
            ids[c, count] = n
            keys[c, count] = F32(z).view(np.uint32)  # positive floats sort as their bits
            count += 1
    return count - lo


@_serial
def _sort(ids, keys, found):
    """One view: joins the segments of CHUNK and radix-sorts them by key (three stable passes of 11 bits, so
    equal depths stay in the order of the input). The ids in depth order lie in ids[: sum of found]."""
    m = found.sum()
    a, ka = np.empty(m, np.int32), np.empty(m, np.uint32)
    b, kb = np.empty(m, np.int32), np.empty(m, np.uint32)
    k = 0
    for s in range(len(found)):
        for i in range(s * CHUNK, s * CHUNK + found[s]):
            a[k], ka[k] = ids[i], keys[i]
            k += 1
    for digit in range(3):
        shift = np.uint32(11 * digit)
        at = np.zeros(2049, np.int64)
        for i in range(m):
            at[((ka[i] >> shift) & np.uint32(2047)) + 1] += 1
        for i in range(2048):
            at[i + 1] += at[i]
        for i in range(m):
            d = (ka[i] >> shift) & np.uint32(2047)
            b[at[d]], kb[at[d]] = a[i], ka[i]
            at[d] += 1
        a, b, ka, kb = b, a, kb, ka
    ids[:m] = a


@_serial
def _prepare(c, r, n, P, xyz, t, velocity, sigma_t, cov, rgb, opacity, c2w, intrinsics, time, width, height):
    """Fills row r of P for Gaussian n in view c."""
    view, _, _, (sxx, sxy, syy) = _project(n, c, xyz, t, velocity, cov, c2w, intrinsics, time, width, height)
    mx = intrinsics[c, 0] * view[1] / view[3] + intrinsics[c, 2]
    my = intrinsics[c, 1] * view[2] / view[3] + intrinsics[c, 3]
    log = math.log2(opacity[n]) - 0.5 * LOG2E * (view[0] / sigma_t[n]) ** 2
    q = max(log - E_MIN, 0.0) * 2 / LOG2E  # squared Mahalanobis distance where alpha is 1/255
    rx, ry = math.sqrt(q * sxx), math.sqrt(q * syy)
    det = sxx * syy - sxy * sxy
    if not (mx + rx > 0 and mx - rx < width and my + ry > 0 and my - ry < height and det > 0):
        P[r, REACH_X] = -1
        return
    scale = math.sqrt(0.5 * LOG2E)
    ux = math.sqrt(syy / det)
    P[r, MX], P[r, MY], P[r, LOG] = mx, my, log
    P[r, UX], P[r, UY], P[r, VY] = scale * ux, -scale * sxy / (det * ux), scale / math.sqrt(syy)
    P[r, RED], P[r, GREEN], P[r, BLUE] = rgb[n, 0], rgb[n, 1], rgb[n, 2]
    P[r, REACH_X], P[r, REACH_Y], P[r, TILT] = rx, ry, sxy * math.sqrt(q / sxx)


@_serial
def _bin(P, first, last, width, height, at, pairs, write):
    """Counts (at[tile] += 1) or, with `write`, lists (pairs[at[tile]++] = row) the rows [first, last) of one
    view in the tiles that they reach: per row of tiles the exact extent of the ellipse in that band."""
    across, down = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    for r in range(first, last):
        if P[r, REACH_X] < 0:
            continue
        mx, my, ry = np.float64(P[r, MX]), np.float64(P[r, MY]), np.float64(P[r, REACH_Y])
        ux, vy = np.float64(P[r, UX]), np.float64(P[r, VY])
        slope, s = P[r, UY] / ux, np.float64(P[r, LOG] - E_MIN)
        for ty in range(int(max(my - ry, 0.0)) // TILE, min(int(min(my + ry, height - 1.0)) // TILE, down - 1) + 1):
            low, high = max(ty * TILE - my, -ry), min(ty * TILE + TILE - my, ry)
            dy = min(max(-P[r, TILT], low), high)
            left = mx - slope * dy - math.sqrt(max(s - (vy * dy) ** 2, 0.0)) / ux - 0.01
            dy = min(max(P[r, TILT], low), high)
            right = mx - slope * dy + math.sqrt(max(s - (vy * dy) ** 2, 0.0)) / ux + 0.01
            if right < 0 or left > width:
                continue
            for tx in range(int(max(left, 0.0)) // TILE, min(int(min(right, width - 1.0)) // TILE, across - 1) + 1):
                tile = ty * across + tx
                if write:
                    pairs[at[tile]] = r
                at[tile] += 1


@_serial
def _span(P, r, y, dy, x0, x1):
    """The pixels [a, b] of row y within [x0, x1] where alpha may reach 1/255, and u, v at offset (0, dy)."""
    v = P[r, VY] * dy
    k = P[r, LOG] - v * v
    s = k - E_MIN
    if s < 0:
        return 0, -1, v, k
    inverse = F32(1) / P[r, UX]
    centre, half = P[r, MX] - P[r, UY] * inverse * dy - HALF, math.sqrt(s) * inverse + SLACK
    a = int(math.ceil(max(centre - half, F32(x0))))
    b = int(math.floor(min(centre + half, F32(x1))))
    return a, b, v, k


@_serial
def _blend(P, pairs, first, last, x0, y0, w, h, state):
    """Blends one tile into state, planes T r g b index by row of pixels. T < 0: stopped with |T| left."""
    for y in range(h):
        for x in range(STRIDE):
            state[y * 5 * STRIDE + x] = 1
            for plane in range(1, 5):
                state[(y * 5 + plane) * STRIDE + x] = 0
    zero, lowest, highest, stop = splat(F32(0)), splat(E_MIN), splat(ALPHA_MAX), splat(T_STOP)
    for i in range(first, last):
        r = pairs[i]
        my, ry = P[r, MY], P[r, REACH_Y]
        ux, red, green, blue = splat(P[r, UX]), splat(P[r, RED]), splat(P[r, GREEN]), splat(P[r, BLUE])
        index = splat(F32(i - first + 1))
        top, bottom = max(my - ry - HALF, F32(y0)), min(my + ry - HALF, F32(y0 + h - 1))
        for y in range(int(math.ceil(top)), int(math.floor(bottom)) + 1):
            dy = F32(y) + HALF - my
            a, b, v, k = _span(P, r, y, dy, x0, x0 + w - 1)
            row = (y - y0) * 5 * STRIDE - x0
            for x in range(a, b + 1, 8):
                at = row + x
                T = load(state, at)
                if not any_lane(T > zero):
                    continue
                u = fma(ux, ramp() + splat(F32(x) + HALF - P[r, MX]), splat(P[r, UY] * dy))
                e = fma(-u, u, splat(k))
                alpha = exp2(e)
                alpha = select(alpha > highest, highest, alpha)
                after = fma(-alpha, T, T)
                reached = e >= lowest
                go = reached & (after > stop)
                weight = select(go, alpha * T, zero)
                stopped = select(reached & (T > zero), -T, T)
                store(state, at, select(go, after, stopped))
                at += STRIDE
                store(state, at, fma(weight, red, load(state, at)))
                at += STRIDE
                store(state, at, fma(weight, green, load(state, at)))
                at += STRIDE
                store(state, at, fma(weight, blue, load(state, at)))
                at += STRIDE
                store(state, at, select(go, index, load(state, at)))


@_serial
def _unblend(P, pairs, first, last, x0, y0, w, h, state, sums):
    """Backward through one tile: state has planes T, B (the colour behind, dotted with the gradient, over its
    own transmittance), dL/dr, dL/dg, dL/db, index. Rows [first, last) of sums are written."""
    zero, one, lowest, highest = splat(F32(0)), splat(F32(1)), splat(E_MIN), splat(ALPHA_MAX)
    for i in range(last - 1, first - 1, -1):
        r = pairs[i]
        my, ry = P[r, MY], P[r, REACH_Y]
        ux, red, green, blue = splat(P[r, UX]), splat(P[r, RED]), splat(P[r, GREEN]), splat(P[r, BLUE])
        index = splat(F32(i - first + 1))
        s_red, s_green, s_blue, s_h, s_hu, s_hv = zero, zero, zero, zero, zero, zero
        s_huu, s_huv, s_hvv = zero, zero, zero
        top, bottom = max(my - ry - HALF, F32(y0)), min(my + ry - HALF, F32(y0 + h - 1))
        for y in range(int(math.ceil(top)), int(math.floor(bottom)) + 1):
            dy = F32(y) + HALF - my
            a, b, v, k = _span(P, r, y, dy, x0, x0 + w - 1)
            row = (y - y0) * 6 * STRIDE - x0
            for x in range(a, b + 1, 8):
                at = row + x
                seen = load(state, at + 5 * STRIDE) >= index
                if not any_lane(seen):
                    continue
                u = fma(ux, ramp() + splat(F32(x) + HALF - P[r, MX]), splat(P[r, UY] * dy))
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


@_parallel
def _forward(
    xyz, t, velocity, sigma_t, cov, rgb, opacity, c2w, intrinsics, time, width, height, background, inference
):
    views, count = len(time), len(t)
    segments = max((count + CHUNK - 1) // CHUNK, 1)
    ids, keys = np.empty((views, count), np.int32), np.empty((views, count), np.uint32)
    found = np.zeros((views, segments), np.int64)
    for j in prange(views * segments):
        c, s = j // segments, j % segments
        lo, hi = s * CHUNK, min(s * CHUNK + CHUNK, count)
        found[c, s] = _cull(c, lo, hi, xyz, t, velocity, sigma_t, opacity, c2w, time, inference, ids, keys)
    base = np.zeros(views + 1, np.int64)
    for c in prange(views):
        _sort(ids[c], keys[c], found[c])
    for c in range(views):
        base[c + 1] = base[c] + found[c].sum()

    P = np.empty((base[views], PARAMS), np.float32)
    for j in prange(views * segments):
        c, s = j // segments, j % segments
        for r in range(base[c] + s * CHUNK, min(base[c] + s * CHUNK + CHUNK, base[c + 1])):
            n = ids[c, r - base[c]]
            _prepare(
                c, r, n, P, xyz, t, velocity, sigma_t, cov, rgb, opacity, c2w, intrinsics, time, width, height
            )

    across, down = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    tiles = across * down
    starts = np.zeros(views * tiles + 1, np.int64)
    nothing = np.empty(0, np.int32)
    for c in prange(views):
        _bin(P, base[c], base[c + 1], width, height, starts[c * tiles + 1 :], nothing, False)
    for j in range(views * tiles):
        starts[j + 1] += starts[j]
    pairs = np.empty(starts[-1], np.int32)
    at = starts.copy()
    for c in prange(views):
        _bin(P, base[c], base[c + 1], width, height, at[c * tiles :], pairs, True)

    image = np.empty((views, height, width, 3), np.float32)
    alpha = np.empty((views, height, width), np.float32)
    left = np.empty((views, height, width), np.float32)
    index = np.empty((views, height, width), np.float32)
    for j in prange(views * tiles):
        c, x0, y0 = j // tiles, j % across * TILE, j % tiles // across * TILE
        w, h = min(TILE, width - x0), min(TILE, height - y0)
        state = np.empty(TILE * 5 * STRIDE, np.float32)
        _blend(P, pairs, starts[j], starts[j + 1], x0, y0, w, h, state)
        for y in range(h):
            for x in range(w):
                at0 = y * 5 * STRIDE + x
                T = abs(state[at0])
                left[c, y0 + y, x0 + x] = T
                alpha[c, y0 + y, x0 + x] = F32(1) - T
                index[c, y0 + y, x0 + x] = state[at0 + 4 * STRIDE]
                for k in range(3):
                    image[c, y0 + y, x0 + x, k] = state[at0 + (k + 1) * STRIDE] + T * background[k]
    return image, alpha, (ids, base, P, starts, pairs, left, index)


@_serial
def _chain(
    c, r, n, P, S, xyz, t, velocity, sigma_t, cov, opacity, c2w, intrinsics, time, width, height, out
):
    """Adds to row n of `out` what row r of view c, with its summed gradients S, says of the seven inputs."""
    g_xyz, g_t, g_velocity, g_sigma, g_cov, g_rgb, g_opacity = out
    view, m, mc, _ = _project(n, c, xyz, t, velocity, cov, c2w, intrinsics, time, width, height)
    dt, px, py, pz, sx, sy = view
    ux, uy, vy = np.float64(P[r, UX]), np.float64(P[r, UY]), np.float64(P[r, VY])
    # ln alpha = ln o - ½ dᵀ Σ₂⁻¹ d: mean gradient Lᵀ Σ h (u,v), covariance gradient ½ Lᵀ (Σ h (u,v)(u,v)ᵀ) L,
    # where the stored L and (u, v) carry the factor sqrt(½ log2 e) each.
    k = 2 / LOG2E
    gmx, gmy = k * S[HU] * ux, k * (S[HU] * uy + S[HV] * vy)
    k = 0.5 * k * k
    gxx = k * ux * ux * S[HUU]
    gxy = k * ux * (uy * S[HUU] + vy * S[HUV])
    gyy = k * (uy * uy * S[HUU] + 2 * uy * vy * S[HUV] + vy * vy * S[HVV])
    # Σ₂ = M Σ Mᵀ: dL/dΣ = Mᵀ G M, dL/dM = 2 G M Σ
    for i in range(3):
        for j in range(3):
            g_cov[n, i, j] += (
                gxx * m[i] * m[j] + gxy * (m[i] * m[3 + j] + m[3 + i] * m[j]) + gyy * m[3 + i] * m[3 + j]
            )
    j00 = j02 = j11 = j12 = 0.0  # dL/dJ = dL/dM Wᵀ
    for i in range(3):
        a, b = 2 * (gxx * mc[i] + gxy * mc[3 + i]), 2 * (gxy * mc[i] + gyy * mc[3 + i])
        j00 += a * c2w[c, i, 0]
        j02 += a * c2w[c, i, 2]
        j11 += b * c2w[c, i, 1]
        j12 += b * c2w[c, i, 2]
    fx, fy, rz = intrinsics[c, 0], intrinsics[c, 1], 1 / pz
    jx, jy = fx * rz, fy * rz
    gx, gy = jx * gmx, jy * gmy
    gz = -rz * (gx * px + gy * py)
    gz += rz * (jx * (j02 * sx - j00) + jy * (j12 * sy - j11))
    if sx == px * rz:  # the slope was not clamped
        gx -= jx * rz * j02
        gz += jx * rz * sx * j02
    if sy == py * rz:
        gy -= jy * rz * j12
        gz += jy * rz * sy * j12
    g_mean_v = 0.0
    for i in range(3):
        g = c2w[c, i, 0] * gx + c2w[c, i, 1] * gy + c2w[c, i, 2] * gz
        g_xyz[n, i] += g
        g_velocity[n, i] += g * dt
        g_mean_v += g * velocity[n, i]
        g_rgb[n, i] += S[i]
    s = np.float64(sigma_t[n])
    g_opacity[n] += S[H] / opacity[n]
    g_t[n] += S[H] * dt / (s * s) - g_mean_v
    g_sigma[n] += S[H] * dt * dt / (s * s * s)


@_parallel
def _backward(
    xyz, t, velocity, sigma_t, cov, opacity, c2w, intrinsics, time, background, saved, g_image, g_alpha
):
    ids, base, P, starts, pairs, left, index = saved
    views, height, width = left.shape
    across, down = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    tiles, count = across * down, len(t)
    sums = np.empty((len(pairs), SUMS), np.float32)
    used = np.zeros(views * tiles, np.int64)
    for j in prange(views * tiles):
        c, x0, y0 = j // tiles, j % across * TILE, j % tiles // across * TILE
        w, h = min(TILE, width - x0), min(TILE, height - y0)
        state = np.zeros(TILE * 6 * STRIDE, np.float32)
        highest = F32(0)
        for y in range(h):
            for x in range(w):
                at = y * 6 * STRIDE + x
                behind = -g_alpha[c, y0 + y, x0 + x]
                for k in range(3):
                    g = g_image[c, y0 + y, x0 + x, k]
                    state[at + (2 + k) * STRIDE] = g
                    behind += g * background[k]
                state[at], state[at + STRIDE] = left[c, y0 + y, x0 + x], behind
                state[at + 5 * STRIDE] = index[c, y0 + y, x0 + x]
                highest = max(highest, index[c, y0 + y, x0 + x])
        used[j] = starts[j] + int(highest)
        _unblend(P, pairs, starts[j], used[j], x0, y0, w, h, state, sums)

    S = np.zeros((len(P), SUMS), np.float32)
    for c in prange(views):
        for j in range(c * tiles, c * tiles + tiles):
            for i in range(starts[j], used[j]):
                for k in range(SUMS):
                    S[pairs[i], k] += sums[i, k]

    out = (
        np.zeros((count, 3), np.float32),
        np.zeros(count, np.float32),
        np.zeros((count, 3), np.float32),
        np.zeros(count, np.float32),
        np.zeros((count, 3, 3), np.float32),
        np.zeros((count, 3), np.float32),
        np.zeros(count, np.float32),
    )
    for c in range(views):  # one view after the other, so that no two threads write to the same Gaussian
        for r in prange(base[c], base[c + 1]):
            if (S[r] != 0).any():
                _chain(
                    c, r, ids[c, r - base[c]], P, S[r],
                    xyz, t, velocity, sigma_t, cov, opacity, c2w, intrinsics, time, width, height, out
                )  # fmt: skip
    return out


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx, xyz, t, velocity, sigma_t, cov, rgb, opacity, c2w, intrinsics, time, size, background, inference):
        inputs = [x.detach().float().contiguous().numpy() for x in (xyz, t, velocity, sigma_t, cov, rgb, opacity)]
        cameras = [x.detach().double().contiguous().numpy() for x in (c2w, intrinsics, time)]
        background = background.detach().float().contiguous().numpy()
        with _lock:
            image, alpha, saved = _forward(*inputs, *cameras, *size, background, inference)
        ctx.saved = inputs, cameras, background, saved, xyz.dtype
        return torch.from_numpy(image).to(xyz.dtype), torch.from_numpy(alpha).to(xyz.dtype)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, g_image, g_alpha):
        (xyz, t, velocity, sigma_t, cov, _, opacity), cameras, background, saved, dtype = ctx.saved
        g = [x.float().contiguous().numpy() for x in (g_image, g_alpha)]
        with _lock:
            out = _backward(xyz, t, velocity, sigma_t, cov, opacity, *cameras, background, saved, *g)
        return *(torch.from_numpy(x).to(dtype) for x in out), None, None, None, None, None, None


def rasterize(xyz, t, velocity, sigma_t, covariance, rgb, opacity, c2w, intrinsics, time, size, background, inference):
    """See `timesplat.model.rasterize.rasterize`; size = (width, height), background a (3,) tensor."""
    return _Rasterize.apply(
        xyz, t, velocity, sigma_t, covariance, rgb, opacity, c2w, intrinsics, time, size, background, inference
    )
