# SPDX-License-Identifier: GPL-3.0-or-later
"""Depth from several photographs: along each ray, what the other views' silhouettes and colours allow.

Candidate distances along a pixel's ray are scored by how many other views see them inside the silhouette,
in a like colour, and not too near to its rim, weighted by closeness in time. Marching from the camera, the
first candidates that hold take the ray: their mean is the depth, their spread its uncertainty. Three things
make that more than a soft visual hull:
    the whole object's path, from the silhouettes' centroids, is taken out before views of different times
    are compared (one view a frame is the usual case, and most of what moves moves together);
    silhouettes are taken for those of round things: the hull of a few views is a box where the object is an
    ellipse, and its corners lie a fifth of its width off;
    depths are smoothed along the image, uncertain ones by their certain neighbours of a like colour.
It needs posed images with alpha, and nothing that Blender alone knows.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numba
import numpy as np
import torch
from torch import Tensor

from ..parallel import chunks, parallel_for
from ..views import Views, camera_rays
from .features import SCALES, SWEEP_FEATURES, Features, Geometry, scaled_distance
from .lift import MIN_ALPHA, lift_geometry


class SweepSettings(NamedTuple):
    """How rays are swept; the kernels take it as it is here, at compile time."""

    candidates: int = 48  # distances along a ray, over its way through the unit box
    colour_falloff: float = 2.5  # agreement in colour is 1 / (1 + colour_falloff · squared distance)
    density: float = 0.5  # how much of the remaining ray an undisputed candidate takes
    object_end: float = 1.35  # the sum of squared offsets from the silhouettes' middles at which an object ends, …
    end_softness: float = 0.1  # … how softly, …
    crowd: float = 0.05  # … and how much later per full vote beyond two: the hull of many views is the object


class VoterSettings(NamedTuple):
    """Which views judge a ray, and what is known of the object's path."""

    most: int = 16  # views that judge a ray
    memory: float = 1.5  # frames after which another view's vote counts 1/e
    least: float = 0.045  # votes that count less are not heard
    stiffness: float = 2.0  # weight of the object's acceleration (units per frame²) beside its distance from rays
    max_knots: int = 96  # of the object's path


SWEEP = SweepSettings()
VOTERS = VoterSettings()
SMOOTHING = 3  # passes, with strides of 1, 2, 3 … pixels at 128 pixels a side
OPACITY = 0.75  # of the lift's: places are less sure, and several views overlap


class _Voters(NamedTuple):
    """Which n views judge the rays of each of V views."""

    view_index: np.ndarray  # (V,n) the voter
    vote: np.ndarray  # (V,n) how much it counts: 1 at the ray's own time, less the farther away
    share: np.ndarray  # (V,n+1) the same, shared among voters of like direction; the ray's own view comes last
    transform: np.ndarray  # (V,n,3,4) from the view's camera to the voter's, the object's path taken out


class _Cameras(NamedTuple):
    """Of V views, as the kernel takes them."""

    c2w: np.ndarray  # (V,4,4)
    intrinsics: np.ndarray  # (V,4) fx fy cx cy


class _Depths(NamedTuple):
    """What the kernel writes of each pixel, (V,H,W) float32."""

    depth: np.ndarray
    spread: np.ndarray
    certainty: np.ndarray


# The channels of a picture, side by side as the kernels read them.
RED, GREEN, BLUE, LOG_ALPHA, EDGE_OFFSET = range(5)


def sweep_depth(views: Views) -> tuple[Tensor, Tensor, Tensor]:
    """Views with alpha -> planar z (V,H,W), its standard deviation (V,H,W), and certainty (V,H,W) 0..1; zero
    where alpha is below MIN_ALPHA. Deterministic. CPU tensors."""
    return _swept(views)[:3]


def sweep_geometry(views: Views) -> Geometry:
    """Views with alpha -> Geometry with SWEEP_FEATURES: depth by `sweep_depth`, shape and lifetime as the lift has
    them (slopes of the depth; as long as no other view sees the same place or through it), no motion of their own.
    CPU tensors."""
    depth, spread, certainty, edge_offset = _swept(views)
    valid, flow = depth > 0, torch.zeros(*depth.shape, 4)
    lifted = lift_geometry(replace(views, depth=torch.where(valid, depth, torch.inf), flow=flow))
    lifted.gaussians.opacity = (OPACITY * lifted.gaussians.opacity).clamp_min(1e-3)
    maps = {
        "distance": scaled_distance(depth * camera_rays(views.intrinsics, *views.size).norm(dim=-1)),
        "spread": spread,
        "certainty": certainty,
        "alpha": views.alpha,
        "lifetime": (SCALES.count * expected_lifetime(views))[:, None, None].expand_as(depth),
        "edge_offset": edge_offset,
        **{k: lifted.features[k] for k in ("normal", "frames_before", "frames_after", "agreeing_views")},
    }
    features = Features.build(SWEEP_FEATURES, valid, **{k: m[valid] for k, m in maps.items()})
    return Geometry(lifted.gaussians, lifted.pixel_index, 0.1 + 2 * spread, features)


def expected_lifetime(views: Views) -> Tensor:
    """(V,) half the frames until another view looks from within 50 degrees of a view's direction: about how
    long what it sees must live. Between half a frame and six frames."""
    frame = views.time / views.frame_step
    forward = views.c2w[:, :3, 2]
    same = forward @ forward.T > math.cos(math.radians(50))
    gap = (frame[:, None] - frame[None]).abs()
    gap = torch.where(same & (gap > 0.5), gap, math.inf).amin(-1)
    return (0.5 * gap).clamp(0.5, 6.0)


def centre_path(views: Views) -> Tensor:
    """(V,3) where the object's middle is at each view's time: the path of least acceleration near the rays
    through the silhouettes' centroids, piecewise linear. Only differences between times mean anything."""
    alpha, ray = views.alpha, camera_rays(views.intrinsics, *views.size)[..., :2]
    mass = alpha.sum((1, 2))
    middle = (alpha[..., None] * ray).sum((1, 2)) / mass[:, None].clamp_min(1e-3)
    R, eye = views.c2w[:, :3, :3], views.c2w[:, :3, 3:]
    A = (R[:, :, :2] - R[:, :, 2:] * middle[:, None]).mT.double() * (mass > 1)[:, None, None]  # A·(centre - eye) = 0
    b = (A @ eye.double())[..., 0]
    frame = (views.time / views.frame_step).double()
    first, length = frame.amin(), float(frame.amax() - frame.amin())
    n = min(math.ceil(length - 1e-3), VOTERS.max_knots - 1) + 1  # knots, one a frame where that is not too many
    place = (frame - first) * ((n - 1) / max(length, 1e-6))
    left = place.floor().long().clamp(0, max(n - 2, 0))
    part = (place - left)[:, None]
    eye_n = torch.eye(n, dtype=torch.float64)
    basis = (1 - part) * eye_n[left] + part * eye_n[(left + 1).clamp_max(n - 1)]
    rows = torch.einsum("vi,vrc->vric", basis, A).reshape(2 * len(views), 3 * n)
    bend = VOTERS.stiffness * torch.diff(torch.diff(eye_n, dim=0), dim=0)
    system = torch.kron(bend.T @ bend + 1e-6 * eye_n, torch.eye(3, dtype=torch.float64)) + rows.T @ rows
    path = torch.linalg.solve(system, rows.T @ b.flatten()).reshape(n, 3)
    return (basis @ path).float()


def _voters(views: Views) -> _Voters:
    V = len(views)
    frame = views.time / views.frame_step
    vote = torch.exp(-(frame[:, None] - frame).abs() / VOTERS.memory)
    vote = vote.masked_fill(torch.eye(V, dtype=torch.bool), 0.0)
    vote = torch.where(vote > VOTERS.least, vote, 0.0)
    scattered = (torch.arange(V) * 0.618034) % 1  # of views equally near in time, some from all over the list
    order = torch.argsort(vote - 1e-3 * scattered, dim=1, descending=True, stable=True)
    index = order[:, : min(VOTERS.most, V - 1)]
    vote = vote.gather(1, index)
    with_own = torch.cat([index, torch.arange(V)[:, None]], 1)
    forward = views.c2w[with_own, :3, 2]
    weight = torch.cat([vote, torch.ones(V, 1)], 1)
    share = weight / (weight[:, None] * (forward @ forward.mT) ** 2).sum(-1)
    centre = centre_path(views)
    moved = views.c2w[:, None].repeat(1, index.shape[1], 1, 1)
    moved[..., :3, 3] += centre[index] - centre[:, None]
    transform = (torch.linalg.inv(views.c2w)[index] @ moved)[..., :3, :]
    return _Voters(*(np.ascontiguousarray(x.numpy()) for x in (index, vote, share, transform)))


def _swept(views: Views) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """-> depth, spread, certainty, and the offset from the silhouettes' middles, each (V,H,W)."""
    alpha = views.alpha.numpy()
    mask = alpha > MIN_ALPHA
    V, H, W = mask.shape
    edge_offset = np.ones(mask.shape, np.float32)
    parallel_for([(i,) for i in range(V)], lambda i: _edge_offsets(mask[i], edge_offset[i]))
    log_alpha = np.log(np.maximum(alpha, np.float32(0.02)))
    pictures = np.concatenate([views.rgb.numpy(), log_alpha[..., None], edge_offset[..., None]], -1).astype(np.float32)
    cameras = _Cameras(*(np.ascontiguousarray(x.numpy()) for x in (views.c2w, views.intrinsics)))
    voters = _voters(views)
    out = _Depths(*(np.zeros(mask.shape, np.float32) for _ in _Depths._fields))
    parallel_for(chunks(V * H, 64), lambda a, b: _sweep(a, b, pictures, mask, voters, cameras, out))
    depth, spread, certainty = out
    for n in range(SMOOTHING):
        stride, old = max(round((n + 1) * W / 128), 1), (depth, spread)
        depth, spread = depth.copy(), spread.copy()
        parallel_for(chunks(V * H, 256), lambda a, b: _smooth(a, b, stride, pictures, *old, depth, spread))  # noqa: B023
    return tuple(map(torch.from_numpy, (depth, spread, certainty, edge_offset)))


@numba.njit(cache=True, nogil=True)
def _edge_offsets(mask, out):
    """mask (H,W) -> out: squared offset of each pixel from the middle of its run of set pixels, 0 there and 1
    at the rim, the greatest of the runs along rows, columns and diagonals; out holds 1 where not set."""
    H, W = mask.shape
    for d in range(4):
        du, dv = (1, 1, 0, -1)[d], (0, 1, 1, 1)[d]
        for v in range(H):
            for u in range(W):
                if not mask[v, u]:
                    continue
                a, b = u - du, v - dv
                if 0 <= a < W and 0 <= b < H and mask[b, a]:
                    continue  # not where a run begins
                n, a, b = 0, u, v
                while 0 <= a < W and 0 <= b < H and mask[b, a]:
                    n, a, b = n + 1, a + du, b + dv
                for k in range(n):
                    offset = np.float32(((2 * k + 1) / n - 1) ** 2)
                    a, b = u + k * du, v + k * dv
                    if d == 0 or offset > out[b, a]:
                        out[b, a] = offset


@numba.njit(cache=True, nogil=True, fastmath=True)
def _sweep(begin, end, pictures, mask, voters, cameras, out):
    """Sweeps the rays of the rows begin…end, counted through all views; pictures (V,H,W,5), mask (V,H,W)."""
    voter, vote, share, transform = voters.view_index, voters.vote, voters.share, voters.transform
    c2w, K = cameras.c2w, cameras.intrinsics
    depth, spread, certainty = out.depth, out.spread, out.certainty
    H, W = mask.shape[1:]
    count = voter.shape[1]
    direction, turned = np.empty(3, np.float32), np.empty((count + 1, 3), np.float32)
    for row in range(begin, end):
        i, v = row // H, row % H
        end_of_object = np.float32(SWEEP.object_end + SWEEP.crowd * max(vote[i].sum() - 2, 0))
        for u in range(W):
            if not mask[i, v, u]:
                continue
            x, y = (u + np.float32(0.5) - K[i, 2]) / K[i, 0], (v + np.float32(0.5) - K[i, 3]) / K[i, 1]
            near, far = np.float32(0.05), np.float32(1e9)  # planar z where the ray is inside [-1,1]^3
            for k in range(3):
                direction[k] = c2w[i, k, 0] * x + c2w[i, k, 1] * y + c2w[i, k, 2]
                if abs(direction[k]) > 1e-6:
                    a, b = (-1 - c2w[i, k, 3]) / direction[k], (1 - c2w[i, k, 3]) / direction[k]
                    near, far = max(near, min(a, b)), min(far, max(a, b))
            if far <= near:
                continue
            for n in range(count):
                for k in range(3):
                    turned[n, k] = transform[i, n, k, 0] * x + transform[i, n, k, 1] * y + transform[i, n, k, 2]
            red, green, blue = pictures[i, v, u, RED], pictures[i, v, u, GREEN], pictures[i, v, u, BLUE]
            step = (far - near) / SWEEP.candidates
            left, total, best = np.float32(1), np.float32(0), np.float32(0)
            mean, square = np.float32(0), np.float32(0)
            for candidate in range(SWEEP.candidates):
                z = near + (candidate + np.float32(0.5)) * step
                inside, agree, votes = np.float32(0), np.float32(0), np.float32(0)
                offsets, shares = share[i, count] * pictures[i, v, u, EDGE_OFFSET], share[i, count]
                for n in range(count):
                    weight = vote[i, n]
                    zj = transform[i, n, 2, 3] + z * turned[n, 2]
                    if weight == 0 or zj < 0.01:
                        continue
                    j, scale = voter[i, n], 1 / zj
                    uj = int(np.floor((transform[i, n, 0, 3] + z * turned[n, 0]) * scale * K[j, 0] + K[j, 2]))
                    vj = int(np.floor((transform[i, n, 1, 3] + z * turned[n, 1]) * scale * K[j, 1] + K[j, 3]))
                    if uj < 0 or vj < 0 or uj >= W or vj >= H:
                        continue
                    seen = pictures[j, vj, uj]
                    inside += weight * seen[LOG_ALPHA]
                    if inside < -7:
                        break
                    d = (seen[RED] - red) ** 2 + (seen[GREEN] - green) ** 2 + (seen[BLUE] - blue) ** 2
                    agree += weight / (1 + d * np.float32(SWEEP.colour_falloff))
                    votes += weight
                    offsets += share[i, n] * seen[EDGE_OFFSET]
                    shares += share[i, n]
                if inside < -7:
                    continue
                hold = np.exp(inside)
                if votes > 0:
                    hold *= np.float32(0.4) + np.float32(0.6) * agree / votes
                hold /= 1 + np.exp((2 * offsets / shares - end_of_object) / np.float32(SWEEP.end_softness))
                weight = left * np.float32(SWEEP.density) * hold
                left *= 1 - np.float32(SWEEP.density) * hold
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
            spread[i, v, u] = np.sqrt(max(square / total - mean * mean, np.float32(0)))
            certainty[i, v, u] = min(best, 1)


@numba.njit(cache=True, nogil=True, fastmath=True)
def _smooth(begin, end, stride, pictures, old, sigma, depth, spread):
    """Rows begin…end: each depth becomes the mean of itself and its eight neighbours `stride` away, weighted
    by their inverse variance, by likeness in colour, and by nearness in depth (a step stays a step)."""
    H, W = old.shape[1:]
    for row in range(begin, end):
        i, v = row // H, row % H
        for u in range(W):
            z = old[i, v, u]
            if z <= 0:
                continue
            total, mean, variance = np.float32(0), np.float32(0), np.float32(0)
            own = sigma[i, v, u] ** 2 + np.float32(1e-3)
            for b in range(max(v - stride, v % stride), min(v + stride + 1, H), stride):
                for a in range(max(u - stride, u % stride), min(u + stride + 1, W), stride):
                    zn = old[i, b, a]
                    if zn <= 0:
                        continue
                    d = np.float32(0)
                    for k in range(3):
                        d += (pictures[i, b, a, k] - pictures[i, v, u, k]) ** 2
                    var = sigma[i, b, a] ** 2 + np.float32(1e-3)
                    gap = (zn - z) ** 2 / (own + var)
                    w = 1 / (var * (1 + 20 * d) * (1 + gap))
                    total += w
                    mean += w * zn
                    variance += w * sigma[i, b, a]
            depth[i, v, u] = mean / total
            spread[i, v, u] = variance / total
