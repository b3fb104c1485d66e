# SPDX-License-Identifier: GPL-3.0-or-later
"""The CPU backend's per-Gaussian half: cull, sort, project, bin; and the chain rule back to the seven inputs.

Scalar float64 code: a few hundred flops per Gaussian and view are little beside its pixels, and near cameras
and thin Gaussians need the digits. Loops live inside the functions that take arrays: numba counts references
on every call, which two threads would fight over.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from . import ALPHA_MIN, BLUR, FILTER, MARGIN, NEAR

TILE = 64  # pixels a side; of 16, 32 and 64 the fastest at 128²
F32 = np.float32
LOG2E = math.log2(math.e)
E_MIN = F32(math.log2(ALPHA_MIN))
# TRAP: numba's cache watches only the file that a function is in. After a change to a constant above or to
# simd.py, touch the files that use it.
serial = njit(cache=True, nogil=True, error_model="numpy")

# One row per surviving Gaussian and view, in depth order. (u, v) = L d whitens the pixel offset d = (dx, dy),
# L = [[UX, UY], [0, VY]], scaled so that alpha = 2^(LOG - u² - v²). INVERSE = 1 / UX; SLOPE = UY / UX.
# REACH: half sides of the box where alpha >= 1/255 (x: -1 outside the image); TILT: dy of its rightmost point.
MX, MY, UX, UY, VY, LOG, RED, GREEN, BLUE, REACH_X, REACH_Y, TILT, INVERSE, SLOPE = range(14)
PARAMS = 16
# Sums over pixels, per (tile, Gaussian) pair: d/d(r, g, b), then of h = dL/d(ln alpha) the moments in u and v.
H, HU, HV, HUU, HUV, HVV = range(3, 9)
SUMS = 9


@serial
def _cull(c, xyz, t, velocity, sigma_t, opacity, c2w, time, inference):
    """Ids and float32 depths of the Gaussians that may be seen from view c, in the order of the input."""
    zx, zy, zz = c2w[c, 0, 2], c2w[c, 1, 2], c2w[c, 2, 2]
    cx, cy, cz, now = c2w[c, 0, 3], c2w[c, 1, 3], c2w[c, 2, 3], time[c]
    ids, depths, count = np.empty(len(t), np.int32), np.empty(len(t), np.float32), 0
    for n in range(len(t)):
        dt = now - t[n]
        e = 0.5 * (dt / sigma_t[n]) ** 2
        o = np.float64(opacity[n])
        if e > 5.55 + max(o - 1, 0.0):  # > ln(255 o)
            continue
        marginal = math.exp(-e)
        if o * marginal < ALPHA_MIN or (inference and (marginal < FILTER or o * marginal < FILTER)):
            continue
        x, y = xyz[n, 0] + velocity[n, 0] * dt - cx, xyz[n, 1] + velocity[n, 1] * dt - cy
        z = zx * x + zy * y + zz * (xyz[n, 2] + velocity[n, 2] * dt - cz)
        if z >= NEAR:
            ids[count], depths[count] = n, z
            count += 1
    return ids[:count], depths[:count]


@serial
def _sort(ids, depths):
    """ids by depth: a radix sort of the floats' bits (which sort as positive floats do), three stable passes of
    11 bits, so equal depths stay in the order of the input."""
    a, ka, m = ids, depths.view(np.uint32), len(ids)
    b, kb = np.empty_like(a), np.empty_like(ka)
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
    return a


@serial
def _camera(c, c2w, intrinsics, width, height):
    """Axes x y z (3 each), centre (3), fx fy cx cy, and the slopes' lower and upper bounds in x and y."""
    fx, fy, cx, cy = intrinsics[c, 0], intrinsics[c, 1], intrinsics[c, 2], intrinsics[c, 3]
    mx, my = MARGIN * 0.5 * width / fx, MARGIN * 0.5 * height / fy
    return (
        (c2w[c, 0, 0], c2w[c, 1, 0], c2w[c, 2, 0]),
        (c2w[c, 0, 1], c2w[c, 1, 1], c2w[c, 2, 1]),
        (c2w[c, 0, 2], c2w[c, 1, 2], c2w[c, 2, 2]),
        (c2w[c, 0, 3], c2w[c, 1, 3], c2w[c, 2, 3]),
        (fx, fy, cx, cy),
        (-cx / fx - mx, (width - cx) / fx + mx, -cy / fy - my, (height - cy) / fy + my),
    )


@serial
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@serial
def _times(m, s):
    """Row vector m times the symmetric matrix s = (xx, xy, xz, yy, yz, zz)."""
    return _dot(m, (s[0], s[1], s[2])), _dot(m, (s[1], s[3], s[4])), _dot(m, (s[2], s[4], s[5]))


@serial
def _project(camera, mean, cov):
    """-> camera-space centre, clamped slopes, the rows m, k of M = J W, the rows of M Σ, Σ₂ = M Σ Mᵀ + blur."""
    ax, ay, az, centre, (fx, fy, _, _), bounds = camera
    d = (mean[0] - centre[0], mean[1] - centre[1], mean[2] - centre[2])
    p = (_dot(ax, d), _dot(ay, d), _dot(az, d))
    rz = 1 / p[2]
    sx = min(max(p[0] * rz, bounds[0]), bounds[1])
    sy = min(max(p[1] * rz, bounds[2]), bounds[3])
    jx, jy = fx * rz, fy * rz
    m = (jx * (ax[0] - sx * az[0]), jx * (ax[1] - sx * az[1]), jx * (ax[2] - sx * az[2]))
    k = (jy * (ay[0] - sy * az[0]), jy * (ay[1] - sy * az[1]), jy * (ay[2] - sy * az[2]))
    ms, ks = _times(m, cov), _times(k, cov)
    return p, (sx, sy), (m, k), (ms, ks), (_dot(ms, m) + BLUR, _dot(ms, k), _dot(ks, k) + BLUR)


@serial
def _gather(n, dt, xyz, velocity, cov):
    """Mean at dt after its own time, and the symmetric part of Σ_3 as (xx, xy, xz, yy, yz, zz)."""
    return (
        (xyz[n, 0] + velocity[n, 0] * dt, xyz[n, 1] + velocity[n, 1] * dt, xyz[n, 2] + velocity[n, 2] * dt),
        (
            np.float64(cov[n, 0, 0]),
            0.5 * (np.float64(cov[n, 0, 1]) + cov[n, 1, 0]),
            0.5 * (np.float64(cov[n, 0, 2]) + cov[n, 2, 0]),
            np.float64(cov[n, 1, 1]),
            0.5 * (np.float64(cov[n, 1, 2]) + cov[n, 2, 1]),
            np.float64(cov[n, 2, 2]),
        ),
    )


@serial
def _prepare(c, ids, P, xyz, t, velocity, sigma_t, cov, rgb, opacity, c2w, intrinsics, time, width, height):
    """Fills the rows of P for the Gaussians `ids` of view c."""
    camera = _camera(c, c2w, intrinsics, width, height)
    scale = math.sqrt(0.5 * LOG2E)
    for r in range(len(ids)):
        n = ids[r]
        dt = time[c] - t[n]
        mean, cov3 = _gather(n, dt, xyz, velocity, cov)
        p, _, _, _, (sxx, sxy, syy) = _project(camera, mean, cov3)
        mx = camera[4][0] * p[0] / p[2] + camera[4][2]
        my = camera[4][1] * p[1] / p[2] + camera[4][3]
        log = math.log2(opacity[n]) - 0.5 * LOG2E * (dt / sigma_t[n]) ** 2
        q = max(log - E_MIN, 0.0) * 2 / LOG2E  # squared Mahalanobis distance where alpha is 1/255
        rx, ry = math.sqrt(q * sxx), math.sqrt(q * syy)
        det = sxx * syy - sxy * sxy
        if not (mx + rx > 0 and mx - rx < width and my + ry > 0 and my - ry < height and det > 0):
            P[r, REACH_X] = -1
            continue
        ux = scale * math.sqrt(syy / det)
        P[r, MX], P[r, MY], P[r, LOG] = mx, my, log
        P[r, UX], P[r, UY], P[r, VY] = ux, -ux * sxy / syy, scale / math.sqrt(syy)
        P[r, INVERSE], P[r, SLOPE] = 1 / ux, -sxy / syy
        P[r, RED], P[r, GREEN], P[r, BLUE] = rgb[n, 0], rgb[n, 1], rgb[n, 2]
        P[r, REACH_X], P[r, REACH_Y], P[r, TILT] = rx, ry, sxy * math.sqrt(q / sxx)


@serial
def _tiles(low, high, n):
    """First and last tile of n pixels that [low, high] touches; it touches one."""
    return int(max(low, 0.0)) // TILE, int(min(high, n - 1.0)) // TILE


@serial
def _bin(P, width, height):
    """-> starts (tiles + 1), pairs: tile j is reached by the rows pairs[starts[j] : starts[j + 1]] of P, in order.
    Per row of tiles the exact extent of the ellipse in that band counts, not its box."""
    across, down = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    bound, n = 0, 0  # by boxes; an array that grew in the loop would cost reference counts on every turn
    for r in range(len(P)):
        if P[r, REACH_X] >= 0:
            left, right = _tiles(P[r, MX] - P[r, REACH_X], P[r, MX] + P[r, REACH_X], width)
            top, bottom = _tiles(P[r, MY] - P[r, REACH_Y], P[r, MY] + P[r, REACH_Y], height)
            bound += (right - left + 2) * (bottom - top + 2)
    tile, row = np.empty(bound, np.int32), np.empty(bound, np.int32)
    starts = np.zeros(across * down + 1, np.int64)
    for r in range(len(P)):
        rx, ry = np.float64(P[r, REACH_X]), np.float64(P[r, REACH_Y])
        if rx < 0:
            continue
        mx, my = np.float64(P[r, MX]), np.float64(P[r, MY])
        top, bottom = _tiles(my - ry, my + ry, height)
        left, right = mx - rx, mx + rx
        for ty in range(top, bottom + 1):
            if rx > TILE // 2:
                low, high = max(ty * TILE - my, -ry), min(ty * TILE + TILE - my, ry)
                a, b = min(max(-P[r, TILT], low), high), min(max(P[r, TILT], low), high)
                s, vy = P[r, LOG] - E_MIN, P[r, VY]
                left = mx - P[r, SLOPE] * a - math.sqrt(max(s - (vy * a) ** 2, 0.0)) * P[r, INVERSE] - 0.01
                right = mx - P[r, SLOPE] * b + math.sqrt(max(s - (vy * b) ** 2, 0.0)) * P[r, INVERSE] + 0.01
                if right < 0 or left > width:
                    continue
            first, last = _tiles(left, right, width)
            for tx in range(first, last + 1):
                tile[n], row[n] = ty * across + tx, r
                starts[tile[n] + 1] += 1
                n += 1
    for j in range(across * down):
        starts[j + 1] += starts[j]
    pairs, at = np.empty(n, np.int32), starts.copy()
    for i in range(n):
        pairs[at[tile[i]]] = row[i]
        at[tile[i]] += 1
    return starts, pairs


@serial
def project_view(c, xyz, t, velocity, sigma_t, cov, rgb, opacity, c2w, intrinsics, time, width, height, inference):
    """View c -> ids of the K Gaussians in depth order, their rows P (K, PARAMS), and the tiles' lists of rows:
    tile j has pairs[starts[j] : starts[j + 1]]."""
    ids = _sort(*_cull(c, xyz, t, velocity, sigma_t, opacity, c2w, time, inference))
    P = np.empty((len(ids), PARAMS), np.float32)
    _prepare(c, ids, P, xyz, t, velocity, sigma_t, cov, rgb, opacity, c2w, intrinsics, time, width, height)
    starts, pairs = _bin(P, width, height)
    return ids, P, starts, pairs


@serial
def chain(c, own, ids, P, S, xyz, t, velocity, sigma_t, cov, rgb, opacity, c2w, intrinsics, time, width, height, out):
    """Adds to the gradients `out` of the seven inputs what the summed gradients S of view c's rows P say of the
    Gaussians own[0] <= n < own[1]."""
    g_xyz, g_t, g_velocity, g_sigma, g_cov, g_rgb, g_opacity = out
    camera = _camera(c, c2w, intrinsics, width, height)
    ax, ay, az, _, (fx, fy, _, _), _ = camera
    for r in range(len(ids)):
        n = ids[r]
        if n < own[0] or n >= own[1]:
            continue
        h, hu, hv, huu, huv, hvv = S[r, H], S[r, HU], S[r, HV], S[r, HUU], S[r, HUV], S[r, HVV]
        for i in range(3):
            g_rgb[n, i] += S[r, i]
        if h == 0 and huu == 0 and hvv == 0:
            continue  # hidden
        dt = time[c] - t[n]
        mean, cov3 = _gather(n, dt, xyz, velocity, cov)
        p, (sx, sy), (m, k), (ms, ks), _ = _project(camera, mean, cov3)
        ux, uy, vy = np.float64(P[r, UX]), np.float64(P[r, UY]), np.float64(P[r, VY])
        # ln alpha = ln o - ½ dᵀ Σ₂⁻¹ d: the mean's gradient is Lᵀ Σ h (u,v), the covariance's
        # ½ Lᵀ (Σ h (u,v)(u,v)ᵀ) L, where the stored L and (u,v) carry a factor sqrt(½ log2 e) each.
        f = 2 / LOG2E
        gmx, gmy = f * hu * ux, f * (hu * uy + hv * vy)
        f *= 0.5 * f
        gxx, gxy = f * ux * ux * huu, f * ux * (uy * huu + vy * huv)
        gyy = f * (uy * uy * huu + 2 * uy * vy * huv + vy * vy * hvv)
        # Σ₂ = M Σ Mᵀ: dL/dΣ = Mᵀ G M, dL/dM = 2 G M Σ, dL/dJ = dL/dM Wᵀ
        for i in range(3):
            a, b = gxx * m[i] + gxy * k[i], gxy * m[i] + gyy * k[i]
            for j in range(3):
                g_cov[n, i, j] += a * m[j] + b * k[j]
        a = (2 * (gxx * ms[0] + gxy * ks[0]), 2 * (gxx * ms[1] + gxy * ks[1]), 2 * (gxx * ms[2] + gxy * ks[2]))
        b = (2 * (gxy * ms[0] + gyy * ks[0]), 2 * (gxy * ms[1] + gyy * ks[1]), 2 * (gxy * ms[2] + gyy * ks[2]))
        j00, j02, j11, j12 = _dot(a, ax), _dot(a, az), _dot(b, ay), _dot(b, az)
        rz = 1 / p[2]
        jx, jy = fx * rz, fy * rz
        gx, gy = jx * gmx, jy * gmy
        gz = rz * (jx * (j02 * sx - j00) + jy * (j12 * sy - j11) - gx * p[0] - gy * p[1])
        if sx == p[0] * rz:  # the slope was not clamped
            gx -= jx * rz * j02
            gz += jx * rz * sx * j02
        if sy == p[1] * rz:
            gy -= jy * rz * j12
            gz += jy * rz * sy * j12
        along = 0.0
        for i in range(3):
            g = ax[i] * gx + ay[i] * gy + az[i] * gz
            g_xyz[n, i] += g
            g_velocity[n, i] += g * dt
            along += g * velocity[n, i]
        s = np.float64(sigma_t[n])
        g_opacity[n] += h / opacity[n]
        g_t[n] += h * dt / (s * s) - along
        g_sigma[n] += h * dt * dt / (s * s * s)
