# SPDX-License-Identifier: GPL-3.0-or-later
"""The Triton backend's kernels: cull, project, blend, and the way back (triton.py calls them in this order).

All take pointers to contiguous float32: xyz (N,3), t (N), velocity (N,3), sigma_t (N), cov (N,3,3), rgb (N,3),
opacity (N), background (3,), image (C,H,W,3), alpha (C,H,W), and of each the gradient, g_…; cameras are float64."""

from __future__ import annotations

import math

import triton
import triton.language as tl

from . import constants

LOG2E = math.log2(math.e)
TILE, GROUP = tl.constexpr(16), tl.constexpr(8)  # pixels a side; Gaussians that a tile takes at once
# The shared limits, as kernels can see them.
NEAR_PLANE, BLUR = tl.constexpr(constants.NEAR_PLANE), tl.constexpr(constants.BLUR)
ALPHA_MIN, ALPHA_MAX = tl.constexpr(constants.ALPHA_MIN), tl.constexpr(constants.ALPHA_MAX)
TRANSMITTANCE_MIN = tl.constexpr(constants.TRANSMITTANCE_MIN)
INFERENCE_MIN = tl.constexpr(constants.INFERENCE_MIN)
LOG_ALPHA_MIN, SCALE = tl.constexpr(math.log2(constants.ALPHA_MIN)), tl.constexpr(0.5 * LOG2E)
UNSCALE, MOMENT = tl.constexpr(2 / LOG2E), tl.constexpr(2 / LOG2E**2)
# A camera is a row of float64: c2w's upper three rows, fx fy cx cy, bounds of the slopes x0 x1 y0 y1, time.
CAMERA = tl.constexpr(21)
# A projected Gaussian is a row of float32: mx my ux uy vy log r g b. (u, v) = (ux dx + uy dy, vy dy) whitens the
# pixel offset (dx, dy) so that alpha = 2^(log - u² - v²). Its gradient too: of r g b, then of h = dL/d(ln alpha)
# the sums over pixels of h, hu, hv, huu, huv, hvv.
ROW = tl.constexpr(9)


@triton.jit
def _double(x, at):
    return tl.load(x + at).to(tl.float64)


@triton.jit
def _place(n, camera, xyz, t, velocity):
    """Time since its own time, and where the Gaussian then is in the camera's axes."""
    dt = _double(camera, 20) - _double(t, n)
    x = _double(xyz, 3 * n) + _double(velocity, 3 * n) * dt - _double(camera, 3)
    y = _double(xyz, 3 * n + 1) + _double(velocity, 3 * n + 1) * dt - _double(camera, 7)
    z = _double(xyz, 3 * n + 2) + _double(velocity, 3 * n + 2) * dt - _double(camera, 11)
    px = _double(camera, 0) * x + _double(camera, 4) * y + _double(camera, 8) * z
    py = _double(camera, 1) * x + _double(camera, 5) * y + _double(camera, 9) * z
    pz = _double(camera, 2) * x + _double(camera, 6) * y + _double(camera, 10) * z
    return dt, px, py, pz


@triton.jit
def _flatten(n, camera, px, py, pz, cov):
    """-> clamped slopes, the rows m, k of M = J W, the rows of M Σ, and Σ₂ = M Σ Mᵀ + blur."""
    jx, jy = _double(camera, 12) / pz, _double(camera, 13) / pz
    sx = tl.minimum(tl.maximum(px / pz, _double(camera, 16)), _double(camera, 17))
    sy = tl.minimum(tl.maximum(py / pz, _double(camera, 18)), _double(camera, 19))
    z0, z1, z2 = _double(camera, 2), _double(camera, 6), _double(camera, 10)
    m0, k0 = jx * (_double(camera, 0) - sx * z0), jy * (_double(camera, 1) - sy * z0)
    m1, k1 = jx * (_double(camera, 4) - sx * z1), jy * (_double(camera, 5) - sy * z1)
    m2, k2 = jx * (_double(camera, 8) - sx * z2), jy * (_double(camera, 9) - sy * z2)
    xx, yy, zz = _double(cov, 9 * n), _double(cov, 9 * n + 4), _double(cov, 9 * n + 8)
    xy = 0.5 * (_double(cov, 9 * n + 1) + _double(cov, 9 * n + 3))
    xz = 0.5 * (_double(cov, 9 * n + 2) + _double(cov, 9 * n + 6))
    yz = 0.5 * (_double(cov, 9 * n + 5) + _double(cov, 9 * n + 7))
    ms0, ks0 = m0 * xx + m1 * xy + m2 * xz, k0 * xx + k1 * xy + k2 * xz
    ms1, ks1 = m0 * xy + m1 * yy + m2 * yz, k0 * xy + k1 * yy + k2 * yz
    ms2, ks2 = m0 * xz + m1 * yz + m2 * zz, k0 * xz + k1 * yz + k2 * zz
    sxx = ms0 * m0 + ms1 * m1 + ms2 * m2 + BLUR
    sxy = ms0 * k0 + ms1 * k1 + ms2 * k2
    syy = ks0 * k0 + ks1 * k1 + ks2 * k2 + BLUR
    return sx, sy, m0, m1, m2, k0, k1, k2, ms0, ms1, ms2, ks0, ks1, ks2, sxx, sxy, syy


@triton.jit
def cull(xyz, t, velocity, sigma_t, opacity, cameras, depth, count, INFERENCE: tl.constexpr, BLOCK: tl.constexpr):
    """depth (C,N): of what may be seen from a view, else -1."""
    c = tl.program_id(1)
    n = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = n < count
    n = tl.where(here, n, 0)
    dt, _, _, z = _place(n, cameras + c * CAMERA, xyz, t, velocity)
    dt /= _double(sigma_t, n)
    marginal = tl.exp(-0.5 * dt * dt)
    o = _double(opacity, n) * marginal
    keep = (z >= NEAR_PLANE) & (o >= ALPHA_MIN)
    if INFERENCE:
        keep &= (marginal >= INFERENCE_MIN) & (o >= INFERENCE_MIN)
    tl.store(depth + c * count + n, tl.where(keep, z, -1.0).to(tl.float32), mask=here)


@triton.jit
def _tiles(low, high, size):
    """First and last tile of `size` pixels that [low, high] touches; it touches one."""
    first = tl.maximum(low, 0.0).to(tl.int32) // TILE
    return first, tl.minimum(high, size - 1.0).to(tl.int32) // TILE


@triton.jit
def project(
    ids, xyz, t, velocity, sigma_t, cov, rgb, opacity, cameras, P, box,
    rows, count, width, height, across, down, BLOCK: tl.constexpr,
):  # fmt: skip
    """Row k of P, and of box its first tile, and how many tiles across and in all, of the pair ids[k] = c N + n."""
    k = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = k < rows
    pair = tl.load(ids + k, mask=here, other=0)
    c = pair // count
    n = pair - c * count
    camera = cameras + c * CAMERA
    dt, px, py, pz = _place(n, camera, xyz, t, velocity)
    _, _, _, _, _, _, _, _, _, _, _, _, _, _, sxx, sxy, syy = _flatten(n, camera, px, py, pz, cov)
    mx = _double(camera, 12) * px / pz + _double(camera, 14)
    my = _double(camera, 13) * py / pz + _double(camera, 15)
    dt /= _double(sigma_t, n)
    log = tl.log2(_double(opacity, n)) - dt * dt * SCALE
    q = tl.maximum(log - LOG_ALPHA_MIN, 0.0) * UNSCALE  # squared Mahalanobis distance where alpha is 1/255
    rx, ry = tl.sqrt(q * sxx), tl.sqrt(q * syy)
    det = sxx * syy - sxy * sxy
    seen = here & (det > 0) & (mx + rx > 0) & (mx - rx < width) & (my + ry > 0) & (my - ry < height)
    mx, my, det = tl.where(seen, mx, 0.0), tl.where(seen, my, 0.0), tl.where(seen, det, 1.0)
    left, right = _tiles(mx - rx, mx + rx, width)
    top, bottom = _tiles(my - ry, my + ry, height)
    tl.store(box + 3 * k, (c * down + top) * across + left, mask=here)
    tl.store(box + 3 * k + 1, right - left + 1, mask=here)
    tl.store(box + 3 * k + 2, tl.where(seen, (right - left + 1) * (bottom - top + 1), 0), mask=here)
    ux = tl.sqrt(syy / det * SCALE)
    P += k * ROW
    tl.store(P, mx.to(tl.float32), mask=here)
    tl.store(P + 1, my.to(tl.float32), mask=here)
    tl.store(P + 2, ux.to(tl.float32), mask=here)
    tl.store(P + 3, (-ux * sxy / syy).to(tl.float32), mask=here)
    tl.store(P + 4, tl.sqrt(1 / syy * SCALE).to(tl.float32), mask=here)
    tl.store(P + 5, log.to(tl.float32), mask=here)
    for i in tl.static_range(3):
        tl.store(P + 6 + i, tl.load(rgb + 3 * n + i), mask=here)


@triton.jit
def _pixels(tile, width, height, across, down):
    """Centres of a tile's pixels, which of them are in the image, and their number in the batch of images."""
    i = tl.arange(0, TILE * TILE)
    x = tile % across * TILE + i % TILE
    y = tile // across % down * TILE + i // TILE
    view = (tile // (across * down)).to(tl.int64)
    return x + 0.5, y + 0.5, (x < width) & (y < height), (view * height + y) * width + x


@triton.jit
def _alphas(P, row, here, x, y):
    """A group of Gaussians (rows of P, where `here`) at all pixels -> u, v, alpha before and after its limits.
    The fused operations are spelt out so that both passes round alike and agree on who reaches 1/255."""
    P += row * ROW
    dx = x[None, :] - tl.load(P, mask=here, other=0.0)[:, None]
    dy = y[None, :] - tl.load(P + 1, mask=here, other=0.0)[:, None]
    v = tl.load(P + 4, mask=here, other=0.0)[:, None] * dy
    u = tl.load(P + 3, mask=here, other=0.0)[:, None] * dy
    u = tl.fma(tl.broadcast_to(tl.load(P + 2, mask=here, other=0.0)[:, None], dx.shape), dx, u)
    log = tl.broadcast_to(tl.load(P + 5, mask=here, other=-200.0)[:, None], dx.shape)
    e = tl.fma(-u, u, tl.fma(-v, v, log))
    raw = tl.exp2(e)
    return u, v, raw, tl.where(e >= LOG_ALPHA_MIN, tl.minimum(raw, ALPHA_MAX), 0.0)


@triton.jit
def blend(P, rows, starts, background, image, alpha, left, last, width, height, across, down):
    """One tile, whose list is rows[starts[tile] : starts[tile + 1]]. left: what the transmittance ends at;
    last: how much of the list was needed."""
    tile = tl.program_id(0)
    x, y, inside, at = _pixels(tile, width, height, across, down)
    start, end = tl.load(starts + tile), tl.load(starts + tile + 1)
    g = tl.arange(0, GROUP)
    through = tl.where(inside, 1.0, 0.0)  # of all, also of those that a stopped pixel no longer draws
    T = tl.full(x.shape, 1.0, tl.float32)
    red, green, blue = tl.zeros_like(x), tl.zeros_like(x), tl.zeros_like(x)
    deep = tl.zeros(x.shape, tl.int32)
    i = start
    while (i < end) & (tl.max(through, 0) > TRANSMITTANCE_MIN):
        here = i + g < end
        row = tl.load(rows + i + g, mask=here, other=0)
        _, _, _, a = _alphas(P, row, here, x, y)
        after = through[None, :] * tl.cumprod(1 - a, 0)
        drawn = after > TRANSMITTANCE_MIN
        weight = tl.where(drawn, a * after / (1 - a), 0.0)
        T = tl.minimum(T, tl.min(tl.where(drawn, after, 1.0), 0))
        through = tl.min(after, 0)
        deep = tl.maximum(deep, tl.max(tl.where(weight > 0, (i - start + 1 + g)[:, None], 0), 0))
        red += tl.sum(weight * tl.load(P + row * ROW + 6, mask=here, other=0.0)[:, None], 0)
        green += tl.sum(weight * tl.load(P + row * ROW + 7, mask=here, other=0.0)[:, None], 0)
        blue += tl.sum(weight * tl.load(P + row * ROW + 8, mask=here, other=0.0)[:, None], 0)
        i += GROUP
    tl.store(image + 3 * at, red + T * tl.load(background), mask=inside)
    tl.store(image + 3 * at + 1, green + T * tl.load(background + 1), mask=inside)
    tl.store(image + 3 * at + 2, blue + T * tl.load(background + 2), mask=inside)
    tl.store(alpha + at, 1 - T, mask=inside)
    tl.store(left + at, T, mask=inside)
    tl.store(last + at, deep, mask=inside)


@triton.jit
def unblend(
    P, rows, places, starts, background, g_image, g_alpha, left, last, sums, width, height, across, down
):  # fmt: skip
    """Backward through one tile: the rows places[starts[tile] : starts[tile + 1]] of sums, as far as needed."""
    tile = tl.program_id(0)
    x, y, inside, at = _pixels(tile, width, height, across, down)
    start = tl.load(starts + tile)
    g = tl.arange(0, GROUP)
    T, deep = tl.load(left + at, mask=inside, other=1.0), tl.load(last + at, mask=inside, other=0)
    g_red = tl.load(g_image + 3 * at, mask=inside, other=0.0)
    g_green = tl.load(g_image + 3 * at + 1, mask=inside, other=0.0)
    g_blue = tl.load(g_image + 3 * at + 2, mask=inside, other=0.0)
    # What lies behind, as it reaches the pixel, dotted with the gradient.
    behind = g_red * tl.load(background) + g_green * tl.load(background + 1) + g_blue * tl.load(background + 2)
    behind = T * (behind - tl.load(g_alpha + at, mask=inside, other=0.0))
    deepest = tl.max(deep, 0)
    groups = (deepest + GROUP - 1) // GROUP
    for k in range(groups):
        i = (groups - 1 - k) * GROUP + g
        here = i < deepest
        row = tl.load(rows + start + i, mask=here, other=0)
        u, v, raw, a = _alphas(P, row, here, x, y)
        a = tl.where(i[:, None] < deep[None, :], a, 0.0)
        before = T[None, :] / tl.cumprod(1 - a, 0, reverse=True)
        weight = a * before
        shade = tl.load(P + row * ROW + 6, mask=here, other=0.0)[:, None] * g_red[None, :]
        shade += tl.load(P + row * ROW + 7, mask=here, other=0.0)[:, None] * g_green[None, :]
        shade += tl.load(P + row * ROW + 8, mask=here, other=0.0)[:, None] * g_blue[None, :]
        shade *= weight
        h = shade - a / (1 - a) * (behind[None, :] + (tl.cumsum(shade, 0, reverse=True) - shade))
        h = tl.where(raw <= ALPHA_MAX, h, 0.0)  # the clamp stops it
        out = sums + tl.load(places + start + i, mask=here, other=0).to(tl.int64) * ROW
        tl.store(out, tl.sum(weight * g_red[None, :], 1), mask=here)
        tl.store(out + 1, tl.sum(weight * g_green[None, :], 1), mask=here)
        tl.store(out + 2, tl.sum(weight * g_blue[None, :], 1), mask=here)
        tl.store(out + 3, tl.sum(h, 1), mask=here)
        tl.store(out + 4, tl.sum(h * u, 1), mask=here)
        tl.store(out + 5, tl.sum(h * v, 1), mask=here)
        tl.store(out + 6, tl.sum(h * u * u, 1), mask=here)
        tl.store(out + 7, tl.sum(h * u * v, 1), mask=here)
        tl.store(out + 8, tl.sum(h * v * v, 1), mask=here)
        T = tl.max(before, 0)
        behind += tl.sum(shade, 0)


@triton.jit
def add_pairs(sums, ends, S, rows, BLOCK: tl.constexpr):
    """Row k of S: the sum of the rows of sums that belong to it, those before ends[k] and not before ends[k - 1]."""
    k = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    first = tl.load(ends + k - 1, mask=(k > 0) & (k < rows), other=0)
    end = tl.load(ends + k, mask=k < rows, other=0)
    f = tl.arange(0, 16)[None, :]
    total = tl.zeros((BLOCK, 16), tl.float32)
    for i in range(tl.max(end - first, 0)):
        mask = (first + i < end)[:, None] & (f < ROW)
        total += tl.load(sums + (first + i)[:, None] * ROW + f, mask=mask, other=0.0)
    tl.store(S + k[:, None] * ROW + f, total, mask=(k < rows)[:, None] & (f < ROW))


@triton.jit
def chain_rule(
    slots, P, S, xyz, t, velocity, sigma_t, cov, opacity, cameras,
    g_xyz, g_t, g_velocity, g_sigma, g_cov, g_rgb, g_opacity, views, count, BLOCK: tl.constexpr,
):  # fmt: skip
    """Gradients of the seven inputs from S; slots (C,N): a Gaussian's row in a view, or -1."""
    n = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    here = n < count
    n = tl.where(here, n, 0)
    o, sigma = _double(opacity, n), _double(sigma_t, n)
    v0, v1, v2 = _double(velocity, 3 * n), _double(velocity, 3 * n + 1), _double(velocity, 3 * n + 2)
    zero = tl.zeros((BLOCK,), tl.float64)
    gt, gs, go = zero, zero, zero
    red, green, blue = zero, zero, zero
    gp0, gp1, gp2, gv0, gv1, gv2 = zero, zero, zero, zero, zero, zero
    c00, c01, c02, c11, c12, c22 = zero, zero, zero, zero, zero, zero
    for c in range(views):
        slot = tl.load(slots + c * count + n, mask=here, other=-1)
        alive = slot >= 0
        at = tl.where(alive, slot, 0) * ROW
        red += tl.load(S + at, mask=alive, other=0.0)
        green += tl.load(S + at + 1, mask=alive, other=0.0)
        blue += tl.load(S + at + 2, mask=alive, other=0.0)
        h = tl.load(S + at + 3, mask=alive, other=0.0).to(tl.float64)
        hu = tl.load(S + at + 4, mask=alive, other=0.0).to(tl.float64)
        hv = tl.load(S + at + 5, mask=alive, other=0.0).to(tl.float64)
        huu = tl.load(S + at + 6, mask=alive, other=0.0).to(tl.float64)
        huv = tl.load(S + at + 7, mask=alive, other=0.0).to(tl.float64)
        hvv = tl.load(S + at + 8, mask=alive, other=0.0).to(tl.float64)
        ux = tl.load(P + at + 2, mask=alive, other=0.0).to(tl.float64)
        uy = tl.load(P + at + 3, mask=alive, other=0.0).to(tl.float64)
        vy = tl.load(P + at + 4, mask=alive, other=0.0).to(tl.float64)
        camera = cameras + c * CAMERA
        dt, px, py, pz = _place(n, camera, xyz, t, velocity)
        pz = tl.where(alive, pz, 1.0)  # all sums are zero where it is not, and 0 times anything finite is 0
        sx, sy, m0, m1, m2, k0, k1, k2, ms0, ms1, ms2, ks0, ks1, ks2, _, _, _ = _flatten(n, camera, px, py, pz, cov)
        # ln alpha = ln o - ½ dᵀ Σ₂⁻¹ d: the mean's gradient is Lᵀ Σ h (u,v), the covariance's
        # ½ Lᵀ (Σ h (u,v)(u,v)ᵀ) L, where L and (u,v) carry a factor sqrt(½ log2 e) each.
        gmx, gmy = hu * ux * UNSCALE, (hu * uy + hv * vy) * UNSCALE
        huu, huv, hvv = huu * MOMENT, huv * MOMENT, hvv * MOMENT
        gxx, gxy = ux * ux * huu, ux * (uy * huu + vy * huv)
        gyy = uy * uy * huu + 2 * uy * vy * huv + vy * vy * hvv
        # Σ₂ = M Σ Mᵀ: dL/dΣ = Mᵀ G M, dL/dM = 2 G M Σ, dL/dJ = dL/dM Wᵀ
        a0, b0 = gxx * m0 + gxy * k0, gxy * m0 + gyy * k0
        a1, b1 = gxx * m1 + gxy * k1, gxy * m1 + gyy * k1
        a2, b2 = gxx * m2 + gxy * k2, gxy * m2 + gyy * k2
        c00, c01, c02 = c00 + a0 * m0 + b0 * k0, c01 + a0 * m1 + b0 * k1, c02 + a0 * m2 + b0 * k2
        c11, c12, c22 = c11 + a1 * m1 + b1 * k1, c12 + a1 * m2 + b1 * k2, c22 + a2 * m2 + b2 * k2
        a0, b0 = 2 * (gxx * ms0 + gxy * ks0), 2 * (gxy * ms0 + gyy * ks0)
        a1, b1 = 2 * (gxx * ms1 + gxy * ks1), 2 * (gxy * ms1 + gyy * ks1)
        a2, b2 = 2 * (gxx * ms2 + gxy * ks2), 2 * (gxy * ms2 + gyy * ks2)
        x0, y0, z0 = _double(camera, 0), _double(camera, 1), _double(camera, 2)
        x1, y1, z1 = _double(camera, 4), _double(camera, 5), _double(camera, 6)
        x2, y2, z2 = _double(camera, 8), _double(camera, 9), _double(camera, 10)
        j00, j02 = a0 * x0 + a1 * x1 + a2 * x2, a0 * z0 + a1 * z1 + a2 * z2
        j11, j12 = b0 * y0 + b1 * y1 + b2 * y2, b0 * z0 + b1 * z1 + b2 * z2
        jx, jy = _double(camera, 12) / pz, _double(camera, 13) / pz
        gx, gy = jx * gmx, jy * gmy
        gz = (jx * (j02 * sx - j00) + jy * (j12 * sy - j11) - gx * px - gy * py) / pz
        # where the slope was not clamped
        j02, j12 = tl.where(sx == px / pz, jx * j02 / pz, 0.0), tl.where(sy == py / pz, jy * j12 / pz, 0.0)
        gx, gy, gz = gx - j02, gy - j12, gz + sx * j02 + sy * j12
        g0, g1, g2 = x0 * gx + y0 * gy + z0 * gz, x1 * gx + y1 * gy + z1 * gz, x2 * gx + y2 * gy + z2 * gz
        gp0, gp1, gp2 = gp0 + g0, gp1 + g1, gp2 + g2
        gv0, gv1, gv2 = gv0 + g0 * dt, gv1 + g1 * dt, gv2 + g2 * dt
        go += h / o
        gt += h * dt / (sigma * sigma) - (g0 * v0 + g1 * v1 + g2 * v2)
        gs += h * dt * dt / (sigma * sigma * sigma)
    tl.store(g_t + n, gt.to(tl.float32), mask=here)
    tl.store(g_sigma + n, gs.to(tl.float32), mask=here)
    tl.store(g_opacity + n, go.to(tl.float32), mask=here)
    _store3(g_rgb + 3 * n, red, green, blue, here)
    _store3(g_xyz + 3 * n, gp0, gp1, gp2, here)
    _store3(g_velocity + 3 * n, gv0, gv1, gv2, here)
    _store3(g_cov + 9 * n, c00, c01, c02, here)
    _store3(g_cov + 9 * n + 3, c01, c11, c12, here)
    _store3(g_cov + 9 * n + 6, c02, c12, c22, here)


@triton.jit
def _store3(at, a, b, c, mask):
    tl.store(at, a.to(tl.float32), mask=mask)
    tl.store(at + 1, b.to(tl.float32), mask=mask)
    tl.store(at + 2, c.to(tl.float32), mask=mask)
