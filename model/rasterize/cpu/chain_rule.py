# SPDX-License-Identifier: GPL-3.0-or-later
"""The chain rule of the CPU backend: from the sums over pixels that the backward pass leaves per (tile, Gaussian) pair
back to the inputs, eight Gaussians at a time, in float64, after projecting them once more (see `project.py`).
"""

from __future__ import annotations

import math

import numpy as np

from .jit import jit
from .layout import HU, HUU, HUV, HV, HVV, LOG2E, SUMS, H, float32
from .project import axes_of, camera_of, covariance_of, dot, mean_of, project
from .simd import gather, load_doubles, select, splat, sqrt, store


@jit
def _turn(q, g):
    """The gradient of the quaternion q = (w, x, y, z) by that of its rotation's rows, g."""
    w, x, y, z = q
    a, b, c = g
    two = splat(2.0)
    return (
        two * (x * (c[1] - b[2]) + y * (a[2] - c[0]) + z * (b[0] - a[1])),
        two * (y * (a[1] + b[0]) + z * (a[2] + c[0]) + w * (c[1] - b[2]) - two * x * (b[1] + c[2])),
        two * (x * (a[1] + b[0]) + z * (b[2] + c[1]) + w * (a[2] - c[0]) - two * y * (a[0] + c[2])),
        two * (x * (a[2] + c[0]) + y * (b[2] + c[1]) + w * (b[0] - a[1]) - two * z * (a[0] + b[1])),
    )


@jit
def _add(out, lanes, k, ids, size, part, count):
    """out[ids[lane], part] += lanes[k, lane], out having rows of `size`."""
    for lane in range(count):
        out[ids[lane] * size + part] += lanes[k * 8 + lane]


@jit
def _store_shape(lanes, shape, rotation, ids, a, b, m, k):
    """The gradient of Σ_3, aᵀ m + bᵀ k, to rows 9 on of lanes; or of scale to 9 on, of the quaternion to 12 on."""
    if rotation is None:
        for i in range(3):
            for j in range(3):
                store(lanes, (9 + 3 * i + j) * 8, a[i] * m[j] + b[i] * k[j])
    else:
        # Σ = A Aᵀ with A = R S, so dL/dA = 2 (dL/dΣ) R S =: 2 G S; dL/ds is the sum down a column of 2 G R S.
        q, s, R = axes_of(shape, rotation, ids, 0)
        two = splat(2.0)
        mR, kR = _row_times(m, R), _row_times(k, R)
        G = (_outer_row(a[0], mR, b[0], kR), _outer_row(a[1], mR, b[1], kR), _outer_row(a[2], mR, b[2], kR))
        v = (two * s[0] * s[0], two * s[1] * s[1], two * s[2] * s[2])
        for i in range(3):
            store(lanes, (9 + i) * 8, two * s[i] * (G[0][i] * R[0][i] + G[1][i] * R[1][i] + G[2][i] * R[2][i]))
        g = _turn(q, (_scaled(G[0], v), _scaled(G[1], v), _scaled(G[2], v)))
        for i in range(4):
            store(lanes, (12 + i) * 8, g[i])


@jit
def _row_times(m, R):
    return (
        m[0] * R[0][0] + m[1] * R[1][0] + m[2] * R[2][0],
        m[0] * R[0][1] + m[1] * R[1][1] + m[2] * R[2][1],
        m[0] * R[0][2] + m[1] * R[1][2] + m[2] * R[2][2],
    )


@jit
def _outer_row(a, m, b, k):
    return a * m[0] + b * k[0], a * m[1] + b * k[1], a * m[2] + b * k[2]


@jit
def _scaled(a, v):
    return a[0] * v[0], a[1] * v[1], a[2] * v[2]


@jit
def _add_shape(g_shape, g_rotation, lanes, ids, count):
    if g_rotation is None:
        for i in range(9):
            _add(g_shape, lanes, 9 + i, ids, 9, i, count)
    else:
        for i in range(3):
            _add(g_shape, lanes, 9 + i, ids, 3, i, count)
        for i in range(4):
            _add(g_rotation, lanes, 12 + i, ids, 4, i, count)


@jit
def chain_rule(c, own, ids, first, sums, inputs, cameras, width, height, out):
    """Adds to the gradients `out` of the inputs, flat as they are, what the gradients `sums` (pairs, SUMS) of view c
    say of the Gaussians own[0] <= n < own[1]. ids, first, inputs, cameras: as `project_view` takes and gives them."""
    xyz, t, velocity, sigma_t, shape, rotation, _, opacity = inputs
    g_xyz, g_t, g_velocity, g_sigma, g_shape, g_rotation, g_rgb, g_opacity = out
    c2w, intrinsics, time = cameras
    camera = camera_of(c, c2w, intrinsics, width, height)
    ax, ay, az, _, (fx, fy, _, _), _ = camera
    now, one, zero, two = splat(time[c]), splat(1.0), splat(0.0), splat(2.0)
    f, scale = splat(2 / LOG2E), splat(math.sqrt(0.5 * LOG2E))
    here, S, lanes = np.zeros(8, np.int32), np.zeros(SUMS * 8, np.float32), np.zeros(18 * 8, np.float32)
    rows = len(ids) - 8
    r, last = np.searchsorted(ids[:rows], own[0]), np.searchsorted(ids[:rows], own[1])
    while r < last:
        count = 0  # of the next eight that are not hidden
        while count < 8 and r < last:
            seen = False
            for k in range(SUMS):
                s = float32(0)
                for slot in range(first[r], first[r + 1]):
                    s += sums[slot, k]
                S[k * 8 + count] = s
                seen |= s != 0
            here[count] = ids[r]
            count += seen
            r += 1
        if count == 0:
            break
        here[count:] = here[0]
        dt, mean = mean_of(here, 0, now, xyz, t, velocity)
        p, (sx, sy), (m, k), (ms, ks), (sxx, sxy, syy) = project(camera, mean, covariance_of(shape, rotation, here, 0))
        ux = scale * sqrt(syy / (sxx * syy - sxy * sxy))
        uy, vy = -ux * sxy / syy, scale / sqrt(syy)
        h, hu, hv = load_doubles(S, H * 8), load_doubles(S, HU * 8), load_doubles(S, HV * 8)
        huu, huv, hvv = load_doubles(S, HUU * 8), load_doubles(S, HUV * 8), load_doubles(S, HVV * 8)
        # ln alpha = ln o - ½ dᵀ Σ₂⁻¹ d: the mean's gradient is Lᵀ Σ h (u,v), the covariance's
        # ½ Lᵀ (Σ h (u,v)(u,v)ᵀ) L, where the stored L and (u,v) carry a factor sqrt(½ log2 e) each.
        gmx, gmy = f * hu * ux, f * (hu * uy + hv * vy)
        ff = splat(2 / LOG2E**2)
        gxx, gxy = ff * ux * ux * huu, ff * ux * (uy * huu + vy * huv)
        gyy = ff * (uy * uy * huu + two * uy * vy * huv + vy * vy * hvv)
        # Σ₂ = M Σ Mᵀ: dL/dΣ = Mᵀ G M, dL/dM = 2 G M Σ, dL/dJ = dL/dM Wᵀ
        a = (gxx * m[0] + gxy * k[0], gxx * m[1] + gxy * k[1], gxx * m[2] + gxy * k[2])
        b = (gxy * m[0] + gyy * k[0], gxy * m[1] + gyy * k[1], gxy * m[2] + gyy * k[2])
        _store_shape(lanes, shape, rotation, here, a, b, m, k)
        a = (two * (gxx * ms[0] + gxy * ks[0]), two * (gxx * ms[1] + gxy * ks[1]), two * (gxx * ms[2] + gxy * ks[2]))
        b = (two * (gxy * ms[0] + gyy * ks[0]), two * (gxy * ms[1] + gyy * ks[1]), two * (gxy * ms[2] + gyy * ks[2]))
        j00, j02, j11, j12 = dot(a, ax), dot(a, az), dot(b, ay), dot(b, az)
        rz = one / p[2]
        jx, jy = fx * rz, fy * rz
        gx, gy = jx * gmx, jy * gmy
        gz = rz * (jx * (j02 * sx - j00) + jy * (j12 * sy - j11) - gx * p[0] - gy * p[1])
        x_free, y_free = sx == p[0] * rz, sy == p[1] * rz  # the slope was not clamped
        bx, by = select(x_free, jx * rz * j02, zero), select(y_free, jy * rz * j12, zero)
        gx, gy, gz = gx - bx, gy - by, gz + bx * sx + by * sy
        g = (
            ax[0] * gx + ay[0] * gy + az[0] * gz,
            ax[1] * gx + ay[1] * gy + az[1] * gz,
            ax[2] * gx + ay[2] * gy + az[2] * gz,
        )
        along = zero
        for i in range(3):
            store(lanes, i * 8, g[i])
            store(lanes, (3 + i) * 8, g[i] * dt)
            along = along + g[i] * gather(velocity, here, 0, 3, i)
        s = gather(sigma_t, here, 0, 1, 0)
        late = h * dt / (s * s)
        store(lanes, 6 * 8, late - along)
        store(lanes, 7 * 8, late * dt / s)
        store(lanes, 8 * 8, h / gather(opacity, here, 0, 1, 0))
        for i in range(3):
            _add(g_xyz, lanes, i, here, 3, i, count)
            _add(g_velocity, lanes, 3 + i, here, 3, i, count)
            _add(g_rgb, S, i, here, 3, i, count)
        _add(g_t, lanes, 6, here, 1, 0, count)
        _add(g_sigma, lanes, 7, here, 1, 0, count)
        _add(g_opacity, lanes, 8, here, 1, 0, count)
        _add_shape(g_shape, g_rotation, lanes, here, count)
