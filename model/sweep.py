# SPDX-License-Identifier: GPL-3.0-or-later
"""Depth from several photographs: along each ray, what the other views' silhouettes and colours allow.

Candidate distances along a pixel's ray are scored by how many other views see them inside the silhouette
and in a like colour, weighted by closeness in time (objects move). Marching from the camera, the first
candidates that hold take the ray: their mean is the depth, their spread its uncertainty. That is a soft
visual hull with colour agreement; it needs posed images with alpha, and nothing that Blender alone knows.
"""

from __future__ import annotations

import math

import numba
import numpy as np
import torch

from .gaussians import Gaussians4D, quaternion
from .lift import FEATURES, Geometry, tangent_frame
from .threads import each, parts
from .views import Views, camera_rays

CANDIDATES = 64  # distances along a ray, over its way through the unit box
MEMORY = 1.5  # frames after which another view's word counts 1/e
AGREE = 2.5  # agreement in colour is 1 / (1 + AGREE · squared distance)
LIFE = 0.6  # σ_t as a multiple of half the time until another view looks from the same side
OPACITY = 0.7  # less than the lift's: places are less sure, and several views overlap
DENSITY = 0.5  # how much of the remaining ray an undisputed candidate takes


def sweep_depth(views: Views) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Views with alpha -> planar z (V,H,W), its standard deviation (V,H,W), and certainty (V,H,W) 0..1; zero
    where alpha is below one half. Deterministic."""
    mask = views.alpha > 0.35
    args = [views.rgb, views.alpha, views.time / views.frame_step, views.c2w, torch.linalg.inv(views.c2w)]
    arrays = [np.ascontiguousarray(x.numpy(), np.float32) for x in (*args, views.intrinsics)]
    out = [np.zeros(mask.shape, np.float32) for _ in range(3)]
    arrays.append(np.log(np.maximum(arrays[1], np.float32(0.02))))
    each(parts(mask.shape[0] * mask.shape[1], 64), lambda a, b: _sweep(a, b, *arrays, mask.numpy(), *out))
    return tuple(map(torch.from_numpy, out))


def sweep_geometry(views: Views) -> Geometry:
    """Views with alpha -> Geometry per pixel: depth by `sweep_depth`, surfaces facing the camera, no motion,
    a lifetime from how soon another view looks from about the same side."""
    depth, spread, certainty = sweep_depth(views)
    valid = depth > 0
    step = views.frame_step
    R = views.c2w[:, :3, :3]
    ray = camera_rays(views.intrinsics, *views.size)
    pixel = depth / views.intrinsics[:, 0, None, None]
    point = ray * depth[..., None]
    facing = torch.zeros_like(point)
    facing[..., 0] = pixel
    scale, axes = tangent_frame(facing, facing.roll(1, -1), point, pixel)
    world = torch.einsum("vij,vhwj->vhwi", R, point) + views.c2w[:, None, None, :3, 3]
    span = relief(views)[:, None, None].expand_as(depth)
    gaussians = Gaussians4D(
        xyz=world,
        t=views.time[:, None, None].expand_as(depth),
        velocity=torch.zeros_like(world),
        sigma_t=LIFE * span * step,
        scale=scale,
        rotation=quaternion((R[:, None, None] @ axes).expand(*depth.shape, 3, 3)),
        rgb=views.rgb,
        opacity=(OPACITY * views.alpha).clamp(1e-3, 0.99),
    ).map(lambda x: x[valid])
    distance = depth * ray.norm(dim=-1)
    maps = [distance / 2.7 - 1, spread, certainty, views.alpha, 0.25 * span]
    features = torch.stack(maps + [torch.zeros_like(depth)] * (FEATURES - len(maps)), -1)
    owner = valid.flatten().nonzero()[:, 0]
    return Geometry(gaussians, owner, 0.1 + 2 * spread, torch.where(valid[..., None], features, 0.0))


def relief(views: Views) -> torch.Tensor:
    """(V,) half the frames until another view looks from within 50 degrees of a view's direction: about how
    long what it sees must live. Between half a frame and six frames."""
    frame = views.time / views.frame_step
    forward = views.c2w[:, :3, 2]
    same = forward @ forward.T > math.cos(math.radians(50))
    gap = (frame[:, None] - frame[None]).abs()
    gap = torch.where(same & (gap > 0.5), gap, math.inf).amin(-1)
    return (0.5 * gap).clamp(0.5, 6.0)


@numba.njit(cache=True, nogil=True, fastmath=True)
def _sweep(begin, end, rgb, alpha, frame, c2w, w2c, K, silhouette, mask, depth, spread, certainty):
    """Rows begin…end, counted through all views; silhouette is the logarithm of alpha."""
    V, H, W = alpha.shape
    for row in range(begin, end):
        i, v = row // H, row % H
        # The views that have a say, and where the camera of this one is in theirs.
        other, say, start = np.empty(V, np.int64), np.empty(V, np.float32), np.empty((V, 3), np.float32)
        count = 0
        for j in range(V):
            dt = abs(frame[j] - frame[i])
            if j != i and dt < 3.1 * MEMORY:
                other[count], say[count] = j, np.exp(-dt / MEMORY)
                for k in range(3):
                    start[count, k] = w2c[j, k, 3]
                    for m in range(3):
                        start[count, k] += w2c[j, k, m] * c2w[i, m, 3]
                count += 1
        direction = np.empty(3, np.float32)
        turned = np.empty((V, 3), np.float32)
        for u in range(W):
            if not mask[i, v, u]:
                continue
            x, y = (u + 0.5 - K[i, 2]) / K[i, 0], (v + 0.5 - K[i, 3]) / K[i, 1]
            near, far = np.float32(0.05), np.float32(1e9)  # planar z where the ray is inside [-1,1]^3
            for k in range(3):
                direction[k] = c2w[i, k, 0] * x + c2w[i, k, 1] * y + c2w[i, k, 2]
                if abs(direction[k]) > 1e-6:
                    a, b = (-1 - c2w[i, k, 3]) / direction[k], (1 - c2w[i, k, 3]) / direction[k]
                    near, far = max(near, min(a, b)), min(far, max(a, b))
            if far <= near:
                continue
            for n in range(count):
                j = other[n]
                for k in range(3):
                    turned[n, k] = (
                        w2c[j, k, 0] * direction[0] + w2c[j, k, 1] * direction[1] + w2c[j, k, 2] * direction[2]
                    )
            red, green, blue = rgb[i, v, u]
            step = (far - near) / CANDIDATES
            left, total, mean, square, best = 1.0, 0.0, 0.0, 0.0, 0.0
            for candidate in range(CANDIDATES):
                z = near + (candidate + np.float32(0.5)) * step
                inside, agree, votes = np.float32(0), np.float32(0), np.float32(0)
                for n in range(count):
                    zj = start[n, 2] + z * turned[n, 2]
                    if zj < 0.01:
                        continue
                    j = other[n]
                    scale = 1 / zj
                    uj = int(np.floor((start[n, 0] + z * turned[n, 0]) * scale * K[j, 0] + K[j, 2]))
                    vj = int(np.floor((start[n, 1] + z * turned[n, 1]) * scale * K[j, 1] + K[j, 3]))
                    if uj < 0 or vj < 0 or uj >= W or vj >= H:
                        continue
                    inside += say[n] * silhouette[j, vj, uj]
                    if inside < -7:
                        break
                    d = (rgb[j, vj, uj, 0] - red) ** 2 + (rgb[j, vj, uj, 1] - green) ** 2
                    d += (rgb[j, vj, uj, 2] - blue) ** 2
                    agree += say[n] / (1 + d * AGREE)
                    votes += say[n]
                if inside < -7:
                    continue
                hold = np.exp(inside)
                if votes > 0:
                    hold *= 0.4 + 0.6 * agree / votes
                weight = left * DENSITY * hold
                left *= 1 - DENSITY * hold
                total += weight
                mean += weight * z
                square += weight * z * z
                best = max(best, hold)
            if total < 1e-4:  # no candidate holds: silhouettes contradict each other (fast motion)
                depth[i, v, u] = 0.5 * (near + far)
                spread[i, v, u] = 0.3 * (far - near)
                continue
            mean /= total
            depth[i, v, u] = mean
            spread[i, v, u] = np.sqrt(max(square / total - mean * mean, 0.0))
            certainty[i, v, u] = best
