# SPDX-License-Identifier: GPL-3.0-or-later
"""How much of an object the cameras saw: what of a reconstruction is surface, looked at from all around.

Where no camera looked, a reconstruction from depth is open: one looks at the inside of its far walls, or through it.
Cameras on a sphere draw the Gaussians; each knows which way its surface faces (the third axis of its rotation,
towards the view that made it). Of what they see of the object, that which faces them is covered; what faces away is
not, nor is the background seen through space that no view has seen to be empty.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from ...datagen.rigs import DISTANCE, spherical
from ...datagen.sequence import focal_from_fov, opengl_to_opencv
from ..gaussians import Gaussians4D
from ..rasterize import render
from ..rotations import rotation_matrix
from ..views import Views


@dataclass(frozen=True)
class CoverageSettings:
    """What counts as seen."""

    grid: int = 40  # voxels along [-1,1] that are seen to be empty, or not
    near_frames: float = 4.5  # a view speaks of the space at moments that are at most so many frames away …
    min_views: int = 8  # … and as many views as this are heard in any case
    min_opacity: float = 0.1  # Gaussians that are fainter at a moment are not drawn
    opacity: float = 0.95  # of those that are: between two views that take turns nothing is transparent


SETTINGS = CoverageSettings()


@torch.inference_mode()
def coverage(
    g: Gaussians4D, views: Views, moments: int = 3, directions: int = 12, size: int = 64
) -> tuple[float, Tensor]:
    """How much of the object the reconstruction g (N,) from these views covers; g from a method that `knows_surface`.

    -> the covered share of what cameras in `directions` directions, size² pixels each, see of the object, 0..1, and
    (moments,) the same at each of that many times, evenly over the clip. 0 where nothing is seen at all. Depth is used
    where the views have it."""
    g, views = g.to("cpu"), views.to("cpu")
    times = torch.linspace(-1, 1, moments) if moments > 1 else torch.zeros(1)
    cameras = sphere_cameras(directions)
    intrinsics = torch.tensor([[focal_from_fov(50, size)] * 2 + [size / 2] * 2])
    missing, shown = torch.zeros(moments), torch.zeros(moments)
    for k, t in enumerate(times):
        now = g[g.opacity * g.marginal(t) > SETTINGS.min_opacity].frozen(float(t))
        now.opacity = torch.full_like(now.opacity, SETTINGS.opacity)
        unseen = unseen_space(views, float(t))
        facing = rotation_matrix(now.rotation)[..., 2]
        pictures = []
        for c2w in cameras:
            towards = (facing * (c2w[:3, 3] - now.xyz)).sum(-1, keepdim=True)
            now.rgb = (towards > 0).float().expand(-1, 3)
            camera = (c2w[None], intrinsics, torch.zeros(1), size, size)
            front, alpha = render(now, *camera, background=0.0)
            hidden = render(unseen, *camera, background=0.0)[1] * (1 - alpha)
            pictures.append(torch.cat([alpha * (2 * front[..., 0] < alpha) + hidden, alpha + hidden]))
        back, whole = torch.stack(pictures, 1)
        # An opening: lines of one or two pixels are the rims of far sides, behind an outline.
        back = -max_pool2d(-back[:, None], 3, 1, 1)
        missing[k], shown[k] = max_pool2d(back, 3, 1, 1).sum(), whole.sum()
    per_time = 1 - missing / shown.clamp_min(1e-6)
    total = float(1 - missing.sum() / shown.sum()) if shown.any() else 0.0
    return total, per_time * (shown > 0)


def sphere_cameras(n: int) -> Tensor:
    """(n,4,4) OpenCV cameras that look at the origin from evenly spread directions (Fibonacci's spiral)."""
    turns = [(i * 180 * (3 - math.sqrt(5)) % 360, math.degrees(math.asin(1 - (2 * i + 1) / n))) for i in range(n)]
    return torch.stack([torch.tensor(opengl_to_opencv(spherical(*x, DISTANCE)), dtype=torch.float32) for x in turns])


def unseen_space(views: Views, t: float) -> Gaussians4D:
    """The voxels that no view around time t (-1..1) saw to be empty, at least a voxel deep, as N round opaque Gaussians
    that do not move. Without depth a view says only that there is nothing beside the silhouette."""
    away = (views.time - t).abs() / views.frame_step
    order = torch.argsort(away, stable=True)
    views = views[order[: max(int((away <= SETTINGS.near_frames).sum()), SETTINGS.min_views)]]
    step = 2 / SETTINGS.grid
    axis = (torch.arange(SETTINGS.grid) + 0.5) * step - 1
    points = torch.cartesian_prod(axis, axis, axis)
    solid = views.alpha > 0.5
    depth = torch.zeros_like(views.alpha) if views.depth is None else views.depth
    empty_to = torch.where(solid, depth, torch.inf)  # how deep each pixel looks
    height, width = views.size
    for w2c, (fx, fy, cx, cy), picture in zip(torch.linalg.inv(views.c2w), views.intrinsics, empty_to, strict=True):
        x, y, z = (points @ w2c[:3, :3].T + w2c[:3, 3]).unbind(-1)
        column, row = (x / z * fx + cx).floor().long(), (y / z * fy + cy).floor().long()
        inside = (z > 0) & (column >= 0) & (row >= 0) & (column < width) & (row < height)
        here = picture[row.clamp(0, height - 1), column.clamp(0, width - 1)]
        points = points[inside & (z > here + step)]
    n = len(points)
    return Gaussians4D(
        xyz=points,
        t=torch.zeros(n),
        velocity=torch.zeros(n, 3),
        sigma_t=torch.full((n,), 1e6),
        scale=torch.full((n, 3), 0.5 * step),
        rotation=torch.tensor([1.0, 0, 0, 0]).expand(n, 4),
        rgb=torch.zeros(n, 3),
        opacity=torch.full((n,), SETTINGS.opacity),
    )
