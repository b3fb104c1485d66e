# SPDX-License-Identifier: GPL-3.0-or-later
"""What costs nothing: the empty picture, and the visual hull in the object's mean colour."""

from __future__ import annotations

import torch

from ..gaussians import FIELDS, Gaussians4D
from ..views import Views

GRID = 48  # voxels along the unit box's side
WINDOW = 4  # views closest in time whose silhouettes carve a moment


def white(views: Views) -> Gaussians4D:
    """No Gaussian at all: the background."""
    shapes = {"xyz": (0, 3), "velocity": (0, 3), "scale": (0, 3), "rotation": (0, 4), "rgb": (0, 3)}
    return Gaussians4D(**{k: torch.zeros(shapes.get(k, (0,))) for k in FIELDS})


def visual_hull(views: Views) -> Gaussians4D:
    """Per moment, the surface voxels inside the silhouettes of the WINDOW views closest in time, in the
    mean colour of the object; each moment's voxels live for about one frame."""
    axis = (torch.arange(GRID) + 0.5) / GRID * 2 - 1
    voxel = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    w2c = torch.linalg.inv(views.c2w)
    local = torch.einsum("vij,nj->vni", w2c[:, :3, :3], voxel) + w2c[:, None, :3, 3]
    K = views.intrinsics[:, None]
    grid = (local[..., :2] / local[..., 2:] * K[..., :2] + K[..., 2:]) / torch.tensor(views.size).flip(0) * 2 - 1
    mask = views.alpha[:, None]
    inside = torch.nn.functional.grid_sample(mask, grid[:, None], mode="nearest", align_corners=False)[:, 0, 0] > 0.5

    weight = views.alpha[..., None]
    colour = (views.rgb * weight).sum((0, 1, 2)) / weight.sum().clamp_min(1e-6)
    moments = views.time.unique()
    step = views.frame_step
    parts = []
    for t in moments:
        nearest = (views.time - t).abs().argsort(stable=True)[:WINDOW]
        solid = inside[nearest].all(0).reshape(GRID, GRID, GRID)
        surface = solid & (torch.nn.functional.avg_pool3d(solid[None].float(), 3, 1, 1)[0] < 0.999)
        xyz = voxel[surface.flatten()]
        n = len(xyz)
        gap = (moments - t).abs()
        life = 0.6 * max(float(gap[gap > 0].min()) if len(moments) > 1 else step, step)
        parts.append(
            Gaussians4D(
                xyz=xyz,
                t=t.expand(n),
                velocity=torch.zeros(n, 3),
                sigma_t=torch.full((n,), life),
                scale=torch.full((n, 3), 0.6 / GRID * 2),
                rotation=torch.tensor([1.0, 0, 0, 0]).expand(n, 4),
                rgb=colour.expand(n, 3),
                opacity=torch.full((n,), 0.95),
            )
        )
    return Gaussians4D.cat(parts)
