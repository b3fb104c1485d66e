# SPDX-License-Identifier: GPL-3.0-or-later
"""Depth and motion vectors straight to 4D Gaussians, without a network.

Every foreground pixel with depth becomes one Gaussian: its place from depth, its shape from the pixel's
footprint on the surface, its velocity from the motion vectors, its lifetime from what the other views
know (`follow.py`). The result is also what the depth-guided network starts from: `Geometry` keeps it per
pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from .follow import follow
from .gaussians import Gaussians4D, quaternion
from .views import Views, camera_rays

FOOTPRINT = 0.45  # σ of a Gaussian in pixels of the view that made it
STRETCH = 4.0  # a slanted pixel's footprint grows at most by this
THICKNESS = 0.15  # σ along the normal, in pixels
OPACITY = 0.95
HANDOVER = 1.3  # σ_t as a multiple of half the span in which a Gaussian is needed
FEATURES = 11  # extra input channels that a Geometry carries


@dataclass
class Geometry:
    """What is known of each pixel of V views before the network: a Gaussian, and how far to trust it."""

    gaussians: Gaussians4D  # fields (V,H,W,…); meaningless where not `valid`
    valid: Tensor  # (V,H,W) bool
    slack: Tensor  # (V,H,W) how far along its ray the network may move it, normalised units
    features: Tensor  # (V,H,W,FEATURES) extra input channels, zero where not valid


def lift(views: Views) -> Gaussians4D:
    """Views with depth and flow -> (N,) Gaussians, one per foreground pixel with depth."""
    geometry = lift_geometry(views)
    return geometry.gaussians[geometry.valid]


def lift_geometry(views: Views) -> Geometry:
    """Views with depth and flow -> Geometry. CPU tensors (the kernel that follows points is compiled)."""
    depth = torch.where(torch.isfinite(views.depth), views.depth, 0.0)
    valid = (views.alpha > 0.35) & (depth > 0)
    focal = views.intrinsics[:, None, None, :2]
    motion = central_flow(views) * depth[..., None] / focal
    slack = 2 * depth / views.intrinsics[:, 0, None, None]
    return geometry_from_depth(views, depth, valid, motion, slack)


def geometry_from_depth(views: Views, depth: Tensor, valid: Tensor, motion: Tensor, slack: Tensor) -> Geometry:
    """depth (V,H,W) planar z, valid (V,H,W), motion (V,H,W,2) of the surface across the view per frame in
    normalised units and camera axes, slack (V,H,W) uncertainty of the depth -> Geometry."""
    step = views.frame_step
    R = views.c2w[:, :3, :3]
    ray = camera_rays(views.intrinsics, *views.size)
    pixel = depth / views.intrinsics[:, 0, None, None]  # a pixel's size at the surface
    point = ray * depth[..., None]
    scale, frame_axes = tangent_frame(
        surface_slope(point, valid, pixel, axis=2), surface_slope(point, valid, pixel, axis=1), point, pixel
    )

    def to_world(x: Tensor) -> Tensor:
        return torch.einsum("vij,vhwj->vhwi", R, x)

    world = to_world(point) + views.c2w[:, None, None, :3, 3]
    normal = to_world(frame_axes[..., 2])
    across = to_world(torch.cat([motion, torch.zeros_like(motion[..., :1])], -1))
    velocity, before, after, support = follow(views, world, across, to_world(ray), normal, pixel, valid, depth)

    middle = 0.5 * (after - before)  # frames from the view's own time to the middle of the span it is needed
    half_span = (0.5 * (after + before)).clamp_min(0.4)
    gaussians = Gaussians4D(
        xyz=world + velocity * middle[..., None],
        t=views.time[:, None, None] + middle * step,
        velocity=velocity / step,
        sigma_t=HANDOVER * half_span * step,
        scale=scale,
        rotation=quaternion(R[:, None, None] @ frame_axes),
        rgb=views.rgb,
        opacity=(OPACITY * views.alpha).clamp(1e-3, 0.99),
    )
    features = [
        (depth * ray.norm(dim=-1) / 2.7 - 1)[..., None],
        normal,
        0.3 * velocity / step,
        0.25 * torch.stack([before, after, support], -1),
        views.alpha[..., None],
    ]
    features = torch.where(valid[..., None], torch.cat(features, -1), 0.0)
    return Geometry(gaussians, valid, slack, features)


def central_flow(views: Views) -> Tensor:
    """(V,H,W,2) motion in pixels per frame: the mean of forward and backward motion vectors; at the clip's
    first and last frame the one that lies inside the clip."""
    ahead, behind = views.flow[..., :2], -views.flow[..., 2:]
    first = (views.time < -1 + 0.5 * views.frame_step)[:, None, None, None]
    last = (views.time > 1 - 0.5 * views.frame_step)[:, None, None, None]
    return torch.where(first, ahead, torch.where(last, behind, 0.5 * (ahead + behind)))


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


def tangent_frame(du: Tensor, dv: Tensor, point: Tensor, pixel: Tensor) -> tuple[Tensor, Tensor]:
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
    length = [torch.minimum(x.sqrt(), STRETCH * pixel) for x in (major, minor)]
    scale = torch.stack([FOOTPRINT * length[0], FOOTPRINT * length[1], THICKNESS * pixel], -1)
    return scale.clamp_min(1e-5), torch.stack([axis, torch.linalg.cross(normal, axis), normal], -1)
