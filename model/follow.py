# SPDX-License-Identifier: GPL-3.0-or-later
"""Following surface points through the other views: how they move, and how long they are needed.

Motion vectors tell how a point moves across the image but not along the ray. That component is the one
whose straight line agrees best with the depth maps of the other views. Then the line is followed forwards
and backwards in time until a view sees through it (there it would hide what that view saw: it must be gone)
or sees the same surface again well enough (whose own pixel takes over from it).
"""

from __future__ import annotations

import numba
import numpy as np
import torch
from torch import Tensor

from .views import Views

TOLERANCE = 1.5  # depth agreement, in pixel sizes, plus …
DRIFT = 0.5  # … this per frame of extrapolation
WINDOW = 6.0  # frames within which other views vote on the motion along the ray
MAX_SPAN = 12.0  # frames that a Gaussian lives on where nothing contradicts it and nobody takes over
FRONTAL = 0.3  # a view that sees a surface under a cosine above this may take over from another
# Candidates of the motion along the ray, in pixel sizes per frame; the prior prefers small ones.
CANDIDATES = np.array([0, -0.25, 0.25, -0.5, 0.5, -1, 1, -1.5, 1.5, -2, 2, -3, 3, -4, 4, -6, 6], np.float32)
PRIOR = 0.05


def follow(
    views: Views,
    world: Tensor,  # (V,H,W,3) surface points
    across: Tensor,  # (V,H,W,3) their motion per frame across the view
    along: Tensor,  # (V,H,W,3) motion that keeps the pixel, per unit of depth
    normal: Tensor,  # (V,H,W,3) unit, towards the camera
    pixel: Tensor,  # (V,H,W) size of a pixel at the surface
    valid: Tensor,  # (V,H,W) bool
    depth: Tensor,  # (V,H,W) planar z where valid
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """-> velocity (V,H,W,3) per frame; before, after (V,H,W) frames that the point is needed to either side
    of its own time; support (V,H,W) how many views agree. Zero where not valid."""
    # Depth of each pixel for the vote: a surface, free space (inf), or unknown (-1: silhouettes).
    seen = torch.where(valid, depth, torch.where(views.alpha < 0.02, torch.inf, -1.0))
    frame = views.time / views.frame_step
    last = 1 / views.frame_step if views.frame_step < 2 else 0.0
    w2c = torch.linalg.inv(views.c2w)
    args = [
        np.ascontiguousarray(x.numpy(), np.float32)
        for x in (world, across, along, normal, pixel, frame, w2c, views.intrinsics, seen)
    ]
    mask = np.ascontiguousarray(valid.numpy())
    radial = _smooth(_radial(*args, mask, CANDIDATES), args[4], args[8], mask)
    velocity = across + along * torch.from_numpy(radial)[..., None]
    args[1] = np.ascontiguousarray(velocity.numpy())
    before, after, support = (torch.from_numpy(x) for x in _span(*args, mask, np.float32(last)))
    return torch.where(valid[..., None], velocity, 0.0), before, after, support


@numba.njit(cache=True, fastmath=True, inline="always")
def _compare(p, j, frame, w2c, K, seen, tol):
    """Where view j has point p (3): (depth error / tol, 1) on a surface or free space (-inf), or (0, 0) where
    it is outside of the image or unknown."""
    z = w2c[j, 2, 0] * p[0] + w2c[j, 2, 1] * p[1] + w2c[j, 2, 2] * p[2] + w2c[j, 2, 3]
    if z < 0.01:
        return 0.0, False
    x = w2c[j, 0, 0] * p[0] + w2c[j, 0, 1] * p[1] + w2c[j, 0, 2] * p[2] + w2c[j, 0, 3]
    y = w2c[j, 1, 0] * p[0] + w2c[j, 1, 1] * p[1] + w2c[j, 1, 2] * p[2] + w2c[j, 1, 3]
    u = int(np.floor(x / z * K[j, 0] + K[j, 2]))
    v = int(np.floor(y / z * K[j, 1] + K[j, 3]))
    if u < 0 or v < 0 or u >= seen.shape[2] or v >= seen.shape[1]:
        return 0.0, False
    d = seen[j, v, u]
    if d < 0:
        return 0.0, False
    return (z - d) / tol, True


@numba.njit(cache=True, parallel=True, fastmath=True)
def _radial(world, across, along, normal, pixel, frame, w2c, K, seen, valid, candidates):
    V, H, W = pixel.shape
    out = np.zeros((V, H, W), np.float32)
    for row in numba.prange(V * H):
        i, v = row // H, row % H
        p = np.empty(3, np.float32)
        for u in range(W):
            if not valid[i, v, u]:
                continue
            best, choice = -1e9, np.float32(0)
            for candidate in candidates:
                r = candidate * pixel[i, v, u]
                score = -PRIOR * abs(candidate)
                for j in range(V):
                    dt = frame[j] - frame[i]
                    if abs(dt) > WINDOW or abs(dt) < 0.5:
                        continue
                    for k in range(3):
                        p[k] = world[i, v, u, k] + dt * (across[i, v, u, k] + r * along[i, v, u, k])
                    tol = (TOLERANCE + DRIFT * abs(dt)) * pixel[i, v, u]
                    error, known = _compare(p, j, frame, w2c, K, seen, tol)
                    if not known:
                        continue
                    weight = np.exp(-abs(dt) / 2)
                    if abs(error) < 2.5:
                        score += weight * np.exp(-0.5 * error * error)
                    if error < -1:
                        score -= weight * min(1.0, -error - 1)
                if score > best:
                    best, choice = score, r
            out[i, v, u] = choice
    return out


@numba.njit(cache=True, parallel=True, fastmath=True)
def _smooth(radial, pixel, seen, valid):
    """Mean over the 5x5 neighbours on the same surface: single pixels choose noisily, parts move together."""
    V, H, W = radial.shape
    out = np.zeros_like(radial)
    for row in numba.prange(V * H):
        i, v = row // H, row % H
        for u in range(W):
            if not valid[i, v, u]:
                continue
            total, count = 0.0, 0
            for y in range(max(v - 2, 0), min(v + 3, H)):
                for x in range(max(u - 2, 0), min(u + 3, W)):
                    if valid[i, y, x] and abs(seen[i, y, x] - seen[i, v, u]) < 4 * pixel[i, v, u]:
                        total += radial[i, y, x]
                        count += 1
            out[i, v, u] = total / count
    return out


@numba.njit(cache=True, parallel=True, fastmath=True)
def _span(world, velocity, along, normal, pixel, frame, w2c, K, seen, valid, last):
    V, H, W = pixel.shape
    before = np.zeros((V, H, W), np.float32)
    after = np.zeros((V, H, W), np.float32)
    support = np.zeros((V, H, W), np.float32)
    order = np.argsort(frame)
    for row in numba.prange(V * H):
        i, v = row // H, row % H
        p = np.empty(3, np.float32)
        for u in range(W):
            if not valid[i, v, u]:
                continue
            for direction in (-1, 1):
                span = min(MAX_SPAN, (last - direction * frame[i]) + 1.0)
                reached = 0.0  # frames up to which nothing contradicts the point
                for n in range(V):
                    j = order[n] if direction > 0 else order[V - 1 - n]
                    dt = frame[j] - frame[i]
                    if direction * dt < 0.5:
                        continue
                    if abs(dt) > MAX_SPAN:
                        break
                    cosine = 0.0
                    distance = 1e-9
                    for k in range(3):
                        p[k] = world[i, v, u, k] + dt * velocity[i, v, u, k]
                        eye = -(w2c[j, 0, k] * w2c[j, 0, 3] + w2c[j, 1, k] * w2c[j, 1, 3] + w2c[j, 2, k] * w2c[j, 2, 3])
                        cosine += normal[i, v, u, k] * (eye - p[k])
                        distance += (eye - p[k]) ** 2
                    cosine /= np.sqrt(distance)
                    tol = (TOLERANCE + DRIFT * abs(dt)) * pixel[i, v, u]
                    error, known = _compare(p, j, frame, w2c, K, seen, tol)
                    if known and error < -1:
                        span = 0.5 * (reached + abs(dt))
                        break
                    reached = abs(dt)
                    if known and abs(error) <= 1:
                        support[i, v, u] += 1
                        if cosine > FRONTAL:
                            span = 0.5 * abs(dt)
                            break
                if direction < 0:
                    before[i, v, u] = span
                else:
                    after[i, v, u] = span
    return before, after, support
