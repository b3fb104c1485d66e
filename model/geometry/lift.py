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

from ..gaussians import Gaussians4D
from ..rotations import quaternion_from_matrix
from ..views import Views, camera_rays
from .tracking import Points, follow

FOOTPRINT = 0.35  # σ of a Gaussian in pixels of the view that made it
STRETCH = 2.5  # a slanted pixel's footprint grows at most by this
THICKNESS = 0.15  # σ along the normal, in pixels
INSET = 1.0  # how far below the surface a Gaussian sits, in pixels: its own width reaches back out to it
OPACITY = 0.95
LIFE = 0.6  # σ_t as a multiple of half a piece's length
SHORTEST = 0.45  # least σ_t, in frames, where a network goes on from there: less, and it cannot close the gaps
ALONE = 0.3  # the same without a network
FEATURES = 12  # extra input channels that a Geometry carries


@dataclass
class Geometry:
    """What is known of the pixels of V views before the network."""

    gaussians: Gaussians4D  # (M,) one or several per valid pixel: the pieces of its point's track
    owner: Tensor  # (M,) the pixel that each belongs to, as an index into (V·H·W), ascending
    slack: Tensor  # (V,H,W) how far along its ray the network may move it, normalised units
    features: Tensor  # (V,H,W,FEATURES) extra input channels, zero where not valid

    def to(self, device) -> Geometry:
        return Geometry(*(x.to(device) for x in vars(self).values()))


def lift(views: Views) -> Gaussians4D:
    """Views with depth and flow -> (M,) Gaussians."""
    return lift_geometry(views, ALONE).gaussians


def lift_geometry(views: Views, shortest: float = SHORTEST) -> Geometry:
    """Views with depth and flow, least σ_t in frames -> Geometry. CPU tensors (the kernel that follows points is
    compiled)."""
    step = views.frame_step
    depth = torch.where(torch.isfinite(views.depth), views.depth, 0.0)
    valid = (views.alpha > 0.35) & (depth > 0)
    ray = camera_rays(views.intrinsics, *views.size)
    pixel = depth / views.intrinsics[:, 0, None, None]  # a pixel's size at the surface
    point = ray * depth[..., None]
    slopes = [surface_slope(point, valid, pixel, axis)[valid] for axis in (2, 1)]

    view = valid.nonzero()[:, 0]
    R, ray, depth, pixel, point = views.c2w[view, :3, :3], ray[valid], depth[valid], pixel[valid], point[valid]
    scale, axes = tangent_frame(*slopes, point, pixel)
    axes = R @ axes
    place = (R @ point[..., None])[..., 0] + views.c2w[view, :3, 3]
    flow, alpha = views.flow[valid], views.alpha[valid]
    points = Points(view, place, axes[..., 2], pixel, flow[:, :2], flow[:, 2:], depth, ray[:, :2])
    # Pixels that mix object and background say nothing about depth.
    seen = torch.where(views.alpha < 0.02, torch.inf, -1.0)
    seen[valid] = depth
    pieces, owner, summary = follow(views, points, seen)

    middle, half, place, velocity = pieces[:, 0], pieces[:, 1], pieces[:, 2:5], pieces[:, 5:8]
    gaussians = Gaussians4D(
        xyz=place - INSET * (pixel[:, None] * points.normal)[owner],
        t=middle * step,
        velocity=velocity / step,
        sigma_t=(LIFE * half).clamp_min(shortest) * step,
        scale=scale[owner],
        rotation=quaternion_from_matrix(axes)[owner],
        rgb=views.rgb[valid][owner],
        opacity=(OPACITY * alpha).clamp(1e-3, 0.99)[owner],
    )
    motion = primary(owner, middle - (views.time / step)[view[owner]], velocity, len(view))
    known = [(depth * ray.norm(dim=-1))[:, None] / 2.7 - 1, points.normal, 0.3 * motion / step]
    known += [summary * torch.tensor([0.25, 0.25, 0.25, 1.0]), alpha[:, None]]
    features = torch.zeros(*views.alpha.shape, FEATURES)
    features[valid] = torch.cat(known, -1)
    slack = torch.zeros_like(views.alpha)
    slack[valid] = 2 * pixel
    return Geometry(gaussians, valid.flatten().nonzero()[:, 0][owner], slack, features)


def primary(owner: Tensor, away: Tensor, values: Tensor, n: int) -> Tensor:
    """values (M,C) of pieces -> (n,C): of each of the n owners' pieces the one with the least |away| (M)."""
    order = torch.argsort(away.abs(), descending=True, stable=True)
    out = torch.zeros(n, values.shape[1])
    out.numpy()[owner[order].numpy()] = values[order].numpy()  # of several writes to one place the last holds
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
