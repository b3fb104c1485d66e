# SPDX-License-Identifier: GPL-3.0-or-later
"""The CPU backend's per-Gaussian half: cull and project; `chain_rule.py` is its way back.

Eight Gaussians at a time, in the order of the input, so that memory is read from one end to the other; in float64,
because near cameras and thin Gaussians need the digits. Loops live inside the functions that take arrays: numba counts
references on every call, which two threads would fight over.
"""

# ruff: noqa: I001 (few lines of constants, not twenty)
from __future__ import annotations

import math

import numpy as np

from ..constants import BLUR, INFERENCE_MIN, NEAR_PLANE, SLOPE_MARGIN
from .jit import jit
from .layout import (
    BLUE, DEPTH, GREEN, INVERSE, LOG, MX, MY, REACH_X, REACH_Y, RED, SLOPE, TILT, UX, UY, VY,
    LOG2E, LOG_ALPHA_MIN, PARAMS,
)  # fmt: skip
from .simd import bits, gather, log2, select, splat, sqrt, store
from .tiles import bin_rows

FAR = 1e30  # pixels beyond which no centre is looked for: rows are float32
LOG_INFERENCE_MIN = math.log2(INFERENCE_MIN)


@jit
def all_finite(arrays):
    """Whether 1D float32 arrays hold neither NaN nor infinity."""
    bad = 0
    for x in arrays:
        for v in x.view(np.uint32):
            bad |= (v & np.uint32(0x7F800000)) == np.uint32(0x7F800000)
    return bad == 0


@jit
def _cull(now, t, sigma_t, opacity, inference):
    """Ids of the Gaussians that may be alive at a time, in the order of the input, and eight more to read over the end;
    how many. A quick look: `_prepare` is exact."""
    ids, count = np.empty(len(t) + 8, np.int32), 0
    most = 2.9958 if inference else 5.5413  # -ln 0.05, ln 255, rounded up
    for n in range(len(t)):
        d = (now - t[n]) / sigma_t[n]
        ids[count] = n
        count += 0.5 * d * d <= most + max(np.float64(opacity[n]) - 1, 0.0)
    ids[count : count + 8] = ids[max(count - 1, 0)]
    return ids, count


@jit
def camera_of(c, c2w, intrinsics, width, height):
    """In all lanes: axes x y z (3 each), centre (3), fx fy cx cy, and the slopes' bounds in x and y."""
    fx, fy, cx, cy = intrinsics[c, 0], intrinsics[c, 1], intrinsics[c, 2], intrinsics[c, 3]
    mx, my = SLOPE_MARGIN * 0.5 * width / fx, SLOPE_MARGIN * 0.5 * height / fy
    return (
        (splat(c2w[c, 0, 0]), splat(c2w[c, 1, 0]), splat(c2w[c, 2, 0])),
        (splat(c2w[c, 0, 1]), splat(c2w[c, 1, 1]), splat(c2w[c, 2, 1])),
        (splat(c2w[c, 0, 2]), splat(c2w[c, 1, 2]), splat(c2w[c, 2, 2])),
        (splat(c2w[c, 0, 3]), splat(c2w[c, 1, 3]), splat(c2w[c, 2, 3])),
        (splat(fx), splat(fy), splat(cx), splat(cy)),
        (splat(-cx / fx - mx), splat((width - cx) / fx + mx), splat(-cy / fy - my), splat((height - cy) / fy + my)),
    )


@jit
def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@jit
def _times(m, s):
    """Row vector m times the symmetric matrix s = (xx, xy, xz, yy, yz, zz)."""
    return dot(m, (s[0], s[1], s[2])), dot(m, (s[1], s[3], s[4])), dot(m, (s[2], s[4], s[5]))


@jit
def _clamp(x, low, high):
    x = select(x > low, x, low)
    return select(x < high, x, high)


@jit
def project(camera, mean, cov):
    """-> camera-space centre, clamped slopes, the rows m, k of M = J W, the rows of M Σ, Σ₂ = M Σ Mᵀ + blur."""
    ax, ay, az, centre, (fx, fy, _, _), bounds = camera
    d = (mean[0] - centre[0], mean[1] - centre[1], mean[2] - centre[2])
    p = (dot(ax, d), dot(ay, d), dot(az, d))
    rz = splat(1.0) / p[2]
    sx, sy = _clamp(p[0] * rz, bounds[0], bounds[1]), _clamp(p[1] * rz, bounds[2], bounds[3])
    jx, jy = fx * rz, fy * rz
    m = (jx * (ax[0] - sx * az[0]), jx * (ax[1] - sx * az[1]), jx * (ax[2] - sx * az[2]))
    k = (jy * (ay[0] - sy * az[0]), jy * (ay[1] - sy * az[1]), jy * (ay[2] - sy * az[2]))
    ms, ks = _times(m, cov), _times(k, cov)
    blur = splat(BLUR)
    return p, (sx, sy), (m, k), (ms, ks), (dot(ms, m) + blur, dot(ms, k), dot(ks, k) + blur)


@jit
def axes_of(shape, rotation, ids, at):
    """Quaternion and scale of eight Gaussians, and the rotation's rows."""
    two, one = splat(2.0), splat(1.0)
    w, x = gather(rotation, ids, at, 4, 0), gather(rotation, ids, at, 4, 1)
    y, z = gather(rotation, ids, at, 4, 2), gather(rotation, ids, at, 4, 3)
    scale = gather(shape, ids, at, 3, 0), gather(shape, ids, at, 3, 1), gather(shape, ids, at, 3, 2)
    R = (
        (one - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y)),
        (two * (x * y + w * z), one - two * (x * x + z * z), two * (y * z - w * x)),
        (two * (x * z - w * y), two * (y * z + w * x), one - two * (x * x + y * y)),
    )
    return (w, x, y, z), scale, R


@jit
def covariance_of(shape, rotation, ids, at):
    """(xx, xy, xz, yy, yz, zz) of eight Gaussians: from scale (3) and quaternion (4), or where that is None the
    symmetric part of Σ_3 (9)."""
    if rotation is None:
        half = splat(0.5)
        return (
            gather(shape, ids, at, 9, 0),
            half * (gather(shape, ids, at, 9, 1) + gather(shape, ids, at, 9, 3)),
            half * (gather(shape, ids, at, 9, 2) + gather(shape, ids, at, 9, 6)),
            gather(shape, ids, at, 9, 4),
            half * (gather(shape, ids, at, 9, 5) + gather(shape, ids, at, 9, 7)),
            gather(shape, ids, at, 9, 8),
        )
    else:
        _, s, (a, b, c) = axes_of(shape, rotation, ids, at)
        v = (s[0] * s[0], s[1] * s[1], s[2] * s[2])
        av, bv = (a[0] * v[0], a[1] * v[1], a[2] * v[2]), (b[0] * v[0], b[1] * v[1], b[2] * v[2])
        cv = (c[0] * v[0], c[1] * v[1], c[2] * v[2])
        return dot(av, a), dot(av, b), dot(av, c), dot(bv, b), dot(bv, c), dot(cv, c)


@jit
def mean_of(ids, at, now, xyz, t, velocity):
    """Time since its own and place of eight Gaussians."""
    dt = now - gather(t, ids, at, 1, 0)
    return dt, (
        gather(xyz, ids, at, 3, 0) + gather(velocity, ids, at, 3, 0) * dt,
        gather(xyz, ids, at, 3, 1) + gather(velocity, ids, at, 3, 1) * dt,
        gather(xyz, ids, at, 3, 2) + gather(velocity, ids, at, 3, 2) * dt,
    )


@jit
def _prepare(
    c, ids, count, P, xyz, t, velocity, sigma_t, shape, rotation, rgb, opacity, c2w, intrinsics, time, width, height,
    inference,
):  # fmt: skip
    """Fills rows of P for those of the first `count` Gaussians `ids` that view c shows, whose ids move to the front;
    how many."""
    camera = camera_of(c, c2w, intrinsics, width, height)
    now, one, zero = splat(time[c]), splat(1.0), splat(0.0)
    scale, least, filtered = splat(math.sqrt(0.5 * LOG2E)), splat(np.float64(LOG_ALPHA_MIN)), splat(LOG_INFERENCE_MIN)
    far = splat(FAR)
    w, h, near = splat(np.float64(width)), splat(np.float64(height)), splat(np.float64(NEAR_PLANE))
    lanes, kept = np.zeros(PARAMS * 8, np.float32), 0
    for at in range(0, count, 8):
        o = gather(opacity, ids, at, 1, 0)
        dt, mean = mean_of(ids, at, now, xyz, t, velocity)
        d = dt / gather(sigma_t, ids, at, 1, 0)
        marginal = splat(-0.5 * LOG2E) * d * d
        log = log2(o) + marginal
        p, _, _, _, (sxx, sxy, syy) = project(camera, mean, covariance_of(shape, rotation, ids, at))
        rz = one / p[2]
        mx, my = camera[4][0] * p[0] * rz + camera[4][2], camera[4][1] * p[1] * rz + camera[4][3]
        q = (log - least) * splat(2 / LOG2E)  # squared Mahalanobis distance where alpha is 1/255
        rx, ry = sqrt(q * sxx), sqrt(q * syy)
        det = sxx * syy - sxy * sxy
        seen = (o > zero) & (log >= least) & (p[2] >= near) & (det > zero)
        seen = seen & (far > mx) & (mx > zero - far) & (far > my) & (my > zero - far)
        seen = seen & (mx + rx > zero) & (w > mx - rx) & (my + ry > zero) & (h > my - ry)
        if inference:
            seen = seen & (marginal >= filtered) & (log >= filtered)
        mask = bits(seen) & ((1 << min(count - at, 8)) - 1)
        if mask == 0:
            continue
        ux = scale * sqrt(syy / det)
        slope = -sxy / syy
        store(lanes, MX * 8, mx)
        store(lanes, MY * 8, my)
        store(lanes, UX * 8, ux)
        store(lanes, UY * 8, ux * slope)
        store(lanes, VY * 8, scale / sqrt(syy))
        store(lanes, LOG * 8, log)
        store(lanes, RED * 8, gather(rgb, ids, at, 3, 0))
        store(lanes, GREEN * 8, gather(rgb, ids, at, 3, 1))
        store(lanes, BLUE * 8, gather(rgb, ids, at, 3, 2))
        store(lanes, REACH_X * 8, rx)
        store(lanes, REACH_Y * 8, ry)
        store(lanes, TILT * 8, sxy * sqrt(q / sxx))
        store(lanes, INVERSE * 8, one / ux)
        store(lanes, SLOPE * 8, slope)
        store(lanes, DEPTH * 8, p[2])
        for lane in range(8):
            if (mask >> lane) & 1:
                ids[kept] = ids[at + lane]
                for k in range(PARAMS):
                    P[kept, k] = lanes[k * 8 + lane]
                kept += 1
    return kept


@jit
def project_view(c, inputs, cameras, width, height, inference):
    """View c -> ids of the K Gaussians in it, in the order of the input, and eight more to read over the end; their
    rows P (K, PARAMS); and starts, pairs, slots, first: see `bin_rows`.

    inputs: float32, flat: xyz (3N), t (N), velocity (3N), sigma_t (N), then scale (3N) and rotation (4N) or Σ_3 (9N)
    and None, rgb (3N), opacity (N). cameras: float64: c2w (C,4,4), intrinsics (C,4), time (C)."""
    xyz, t, velocity, sigma_t, shape, rotation, rgb, opacity = inputs
    c2w, intrinsics, time = cameras
    ids, count = _cull(time[c], t, sigma_t, opacity, inference)
    memory = np.empty((count + 1) * PARAMS, np.float32)
    skip = -memory.ctypes.data % 64 // 4  # a row is a line of the cache
    P = memory[skip : skip + count * PARAMS].reshape(count, PARAMS)
    count = _prepare(
        c, ids, count, P, xyz, t, velocity, sigma_t, shape, rotation, rgb, opacity, c2w, intrinsics, time, width,
        height, inference,
    )  # fmt: skip
    P = P[:count]
    starts, pairs, slots, first = bin_rows(P, width, height)
    return ids[: count + 8], P, starts, pairs, slots, first
