# SPDX-License-Identifier: GPL-3.0-or-later
"""Depth and motion vectors straight to 4D Gaussians, without a network.

Every foreground pixel with depth becomes one Gaussian or several: its place from depth, its shape from the pixel's
footprint on the surface, its velocity from the motion vectors, its lifetime from what the other views know
(tracking.py). The result is also what the depth-guided network starts from: `Geometry` keeps it per pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import NamedTuple

import torch
from torch import Tensor

from ..gaussians import Gaussians4D
from ..rasterize.constants import WIDER
from ..rotations import quaternion_from_matrix
from ..views import Views, camera_rays
from .features import LIFT_FEATURES, SCALES, Features, Geometry, scaled_distance
from .scene_flow import SurfacePoints
from .tracking import track_points

MIN_ALPHA = 0.35  # pixels below it are background, or too mixed to have a depth
AT_ONCE = 16  # views whose every pixel is looked at at a time, for memory's sake
EMPTY_ALPHA = 0.02  # pixels below it show that there is nothing along their ray


@dataclass(frozen=True)
class LiftSettings:
    """How a pixel becomes Gaussians."""

    footprint: float = 0.35  # σ of a Gaussian in pixels of the view that made it
    max_stretch: float = 2.5  # a slanted pixel's footprint grows at most by this
    thickness: float = 0.15  # σ along the normal, in pixels
    inset: float = 1.0  # how far below the surface a Gaussian sits, in pixels: its own width reaches back out to it
    opacity: float = 0.95
    lifetime: float = 0.6  # σ_t as a multiple of half a piece's length
    min_sigma_t: float = 0.45  # in frames, where a network goes on from there: less, and it cannot close the gaps


BEFORE_NETWORK = LiftSettings()
ALONE = LiftSettings(min_sigma_t=0.3)


def lift(views: Views) -> Gaussians4D:
    """Views with depth and flow -> (M,) Gaussians. CPU tensors."""
    return lift_geometry(views, ALONE).gaussians.widened(WIDER * views.pixel)


def lift_geometry(views: Views, settings: LiftSettings = BEFORE_NETWORK) -> Geometry:
    """Views with depth and flow -> Geometry with LIFT_FEATURES. CPU tensors (the kernel that follows points is
    compiled)."""
    step = views.frame_step
    seen = surface_seen(views, settings)
    valid, points, alpha = seen.valid, seen.points, views.alpha[seen.valid]
    view, normal, pixel, depth = points.view, points.normal, points.pixel, points.depth
    pieces, of, summary = track_points(views, points, seen.observed)

    gaussians = Gaussians4D(
        xyz=pieces.place - settings.inset * (pixel[:, None] * normal)[of],
        t=pieces.time * step,
        velocity=pieces.velocity / step,
        sigma_t=(settings.lifetime * pieces.half_length).clamp_min(settings.min_sigma_t) * step,
        scale=seen.scale[of],
        rotation=quaternion_from_matrix(seen.axes)[of],
        rgb=views.rgb[valid][of],
        opacity=(settings.opacity * alpha).clamp(1e-3, 0.99)[of],
    )
    away = pieces.time - (views.time / step)[view[of]]
    features = Features.build(
        LIFT_FEATURES,
        valid,
        distance=scaled_distance(depth * seen.ray.norm(dim=-1)),
        normal=normal,
        motion=SCALES.motion * nearest_in_time(of, away, pieces.velocity, len(view)) / step,
        frames_before=SCALES.count * summary.frames_before,
        frames_after=SCALES.count * summary.frames_after,
        agreeing_views=SCALES.count * summary.agreeing_views,
        contradicted=summary.contradicted,
        alpha=alpha,
    )
    max_shift = torch.zeros_like(views.alpha)
    max_shift[valid] = 2 * pixel
    return Geometry(gaussians, valid.flatten().nonzero()[:, 0][of], max_shift, features)


class Seen(NamedTuple):
    """The surface that V views show in n pixels."""

    valid: Tensor  # (V,H,W) bool, n of them
    points: SurfacePoints
    ray: Tensor  # (n,3) camera space, at planar z = 1
    scale: Tensor  # (n,3) see `tangent_frame`
    axes: Tensor  # (n,3,3) world
    observed: Tensor  # (V,H,W) planar z, free space (inf), or unknown (-1)


def surface_seen(views: Views, settings: LiftSettings = BEFORE_NETWORK) -> Seen:
    """What views with depth and flow show. CPU tensors."""
    found = [_seen_by(views[part], settings) for part in torch.arange(len(views)).split(AT_ONCE)]
    valid = torch.cat([s.valid for s in found])
    points = {f.name: torch.cat([getattr(s.points, f.name) for s in found]) for f in fields(SurfacePoints)}
    points["view"] = valid.nonzero()[:, 0]
    joined = (torch.cat([getattr(s, name) for s in found]) for name in ("ray", "scale", "axes", "observed"))
    return Seen(valid, SurfacePoints(**points), *joined)


def _seen_by(views: Views, settings: LiftSettings) -> Seen:
    depth = torch.where(torch.isfinite(views.depth), views.depth, 0.0)
    valid = (views.alpha > MIN_ALPHA) & (depth > 0)
    ray = camera_rays(views.intrinsics, *views.size)
    pixel = depth / views.intrinsics[:, 0, None, None]  # a pixel's size at the surface
    point = ray * depth[..., None]
    slopes = [surface_slope(point, valid, pixel, axis)[valid] for axis in (2, 1)]

    view = valid.nonzero()[:, 0]
    R, ray, depth, pixel, point = views.c2w[view, :3, :3], ray[valid], depth[valid], pixel[valid], point[valid]
    scale, axes = tangent_frame(*slopes, point, pixel, settings)
    axes = R @ axes
    place = (R @ point[..., None])[..., 0] + views.c2w[view, :3, 3]
    to_next, to_previous = views.flow[valid].split(2, -1)
    # Pixels that mix object and background say nothing about depth.
    observed = torch.where(views.alpha < EMPTY_ALPHA, torch.inf, -1.0)
    observed[valid] = depth
    points = SurfacePoints(view, place, axes[..., 2], pixel, to_next, to_previous, depth, ray[:, :2])
    return Seen(valid, points, ray, scale, axes, observed)


def nearest_in_time(of: Tensor, away: Tensor, values: Tensor, n: int) -> Tensor:
    """values (M,C) of pieces, of (M,) the point 0..n-1 that each belongs to, away (M,) its time from the point's own
    -> (n,C): those of each point's piece with the least |away|."""
    order = torch.argsort(away.abs(), descending=True, stable=True)
    out = torch.zeros(n, values.shape[1])
    out.numpy()[of[order].numpy()] = values[order].numpy()  # of several writes to one place the last holds
    return out


def surface_slope(point: Tensor, valid: Tensor, pixel: Tensor, axis: int) -> Tensor:
    """point (V,H,W,3), valid and pixel (V,H,W) -> (V,H,W,3) change of the surface point per pixel along an
    image axis (1 = down, 2 = right). Of the two one-sided differences the one with less change in depth is
    taken, so that edges between surfaces do not count; a pixel alone is taken to face the camera."""
    inside = valid.narrow(axis, 1, valid.shape[axis] - 1) & valid.narrow(axis, 0, valid.shape[axis] - 1)
    step = torch.where(inside[..., None], torch.diff(point, dim=axis), math.inf)
    edge = torch.full_like(point.narrow(axis, 0, 1), math.inf)
    forward, backward = torch.cat([step, edge], axis), torch.cat([edge, step], axis)
    slope = torch.where(forward[..., 2:].abs() <= backward[..., 2:].abs(), forward, backward)
    facing = torch.zeros_like(point)
    facing[..., 2 - axis] = pixel
    return torch.where(torch.isfinite(slope).all(-1, keepdim=True), slope, facing)


def tangent_frame(
    du: Tensor, dv: Tensor, point: Tensor, pixel: Tensor, settings: LiftSettings = BEFORE_NETWORK
) -> tuple[Tensor, Tensor]:
    """du, dv (…,3) surface steps per pixel, point (…,3) and pixel (…) -> scale (…,3) and axes (…,3,3): the
    ellipse that a round pixel is on the surface, and the normal (third axis, towards the camera)."""
    normal = torch.linalg.cross(dv, du)
    normal = torch.nn.functional.normalize(normal, dim=-1, eps=1e-20)
    normal = torch.where((normal * point).sum(-1, keepdim=True) > 0, -normal, normal)
    # Eigenvalues and the major eigenvector of the 2x2 Gram matrix of (du, dv), in closed form.
    a, b, c = (du * du).sum(-1), (du * dv).sum(-1), (dv * dv).sum(-1)
    root = torch.sqrt((0.5 * (a - c)) ** 2 + b * b)
    major, minor = 0.5 * (a + c) + root, (0.5 * (a + c) - root).clamp_min(0)
    angle = 0.5 * torch.atan2(2 * b, a - c)
    axis = du * torch.cos(angle)[..., None] + dv * torch.sin(angle)[..., None]
    axis = torch.where((pixel > 0)[..., None], axis, torch.tensor([1.0, 0, 0]))
    axis = torch.nn.functional.normalize(axis, dim=-1, eps=1e-20)
    normal = torch.where(normal.norm(dim=-1, keepdim=True) > 0.5, normal, torch.tensor([0.0, 0, -1.0]))
    length = [torch.minimum(x.sqrt(), settings.max_stretch * pixel) for x in (major, minor)]
    sides = [settings.footprint * length[0], settings.footprint * length[1], settings.thickness * pixel]
    scale = torch.stack(sides, -1)
    return scale.clamp_min(1e-5), torch.stack([axis, torch.linalg.cross(normal, axis), normal], -1)
