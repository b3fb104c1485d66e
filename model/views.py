# SPDX-License-Identifier: GPL-3.0-or-later
"""Views: posed, timed images as tensors, and the rays through their pixels."""

from __future__ import annotations

from collections.abc import Sequence as Indices
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from torch import Tensor

from ..datagen.sequence import InputError, Sequence
from ..datagen.track_file import SurfaceTracks

BACKGROUND = 1.0  # white: what pictures are laid on where nothing else is said


@dataclass
class Views:
    """V images of one clip. Colours are sRGB-encoded, 0..1; cameras OpenCV camera-to-world, normalised."""

    rgb: Tensor  # (V,H,W,3) straight colour (not multiplied by alpha)
    alpha: Tensor  # (V,H,W) 0..1
    c2w: Tensor  # (V,4,4)
    intrinsics: Tensor  # (V,4) fx fy cx cy in pixels, pixel centres at +0.5
    time: Tensor  # (V,) -1..1 over the clip
    frame_step: float  # model time between two frames of the clip, 2 / (frames - 1)
    depth: Tensor | None = None  # (V,H,W) planar z, inf where there is no surface
    flow: Tensor | None = None  # (V,H,W,4) pixels to the next frame (x, y) and to the previous one (x, y)
    surface: SurfaceTracks | None = None  # points of the surface, followed by the renderer through the whole clip
    untracked: bool = False  # whether something that is seen has none of them

    def __len__(self) -> int:
        return len(self.rgb)

    def __getitem__(self, index) -> Views:
        pick = {k.name: getattr(self, k.name) for k in fields(self)}
        return Views(**{k: x[index] if isinstance(x, Tensor) else x for k, x in pick.items()})

    def to(self, device) -> Views:
        pick = {k.name: getattr(self, k.name) for k in fields(self)}
        return Views(**{k: x.to(device) if isinstance(x, Tensor) else x for k, x in pick.items()})

    @property
    def size(self) -> tuple[int, int]:
        """Height, width."""
        return self.rgb.shape[1], self.rgb.shape[2]

    @property
    def pixel(self) -> float:
        """The median over the views of a pixel's size at the origin, normalised units."""
        return float((self.c2w[:, :3, 3].norm(dim=-1) / self.intrinsics[:, 0]).median())

    def over(self, background: float | Tensor = BACKGROUND) -> Tensor:
        """(V,H,W,3) the pictures composited over a background (scalar or (3,)), white by default."""
        a = self.alpha[..., None]
        return self.rgb * a + background * (1 - a)


def load_views(seq: Sequence, indices: Indices[int], has_depth: bool = False, size: int | None = None) -> Views:
    """The views of a Sequence at `indices`, has_depth: with depth and flow, and the surface's tracks where it has them.
    size: pixels of the longer side, a whole fraction of what the Sequence has, which is the default; each view is made
    smaller as it is read. Raises InputError for a missing or damaged image, pass or file of tracks, and for a size that
    is no whole fraction."""
    by = shrink_factor(seq, size)
    tensors: dict[str, Tensor] = {}
    for n, i in enumerate(indices):
        view = vars(shrink(_load_view(seq, i, has_depth), by))
        for k, x in view.items():
            if isinstance(x, Tensor):  # room for all views at once: pieces between large pictures would hold memory
                tensors.setdefault(k, x.new_empty(len(indices), *x.shape[1:]))[n] = x[0]
    views = Views(**tensors, frame_step=2 / max(seq.frame_end - seq.frame_start, 1))
    if has_depth:
        views.surface = seq.load_tracks() if seq.tracks else None
        views.untracked = bool(seq.untracked)
    return views


def _load_view(seq: Sequence, index: int, has_depth: bool) -> Views:
    rgba = torch.tensor(seq.load_image(index), dtype=torch.float32)[None] / 255
    c2w, intrinsics = (torch.from_numpy(x) for x in seq.cameras([index]))
    view = Views(rgba[..., :3], rgba[..., 3], c2w, intrinsics, torch.from_numpy(seq.times([index])), 0.0)
    if has_depth:
        p = seq.load_passes(index)
        view.depth = torch.from_numpy(p.depth)[None]
        view.flow = torch.from_numpy(np.concatenate([p.flow_next, p.flow_prev], -1))[None]
    return view


def shrink_factor(seq: Sequence, size: int | None) -> int:
    """How many times smaller the pictures of a Sequence are when their longer side has `size` pixels; 1 for None.
    Raises InputError where it is no whole number, or does not fit both sides."""
    side = max(seq.width, seq.height)
    by = side // size if size and size > 0 else int(size is None)
    if by < 1 or (size and size * by != side) or seq.width % by or seq.height % by:
        raise InputError(f"{seq.root}: {seq.width}x{seq.height} pixels do not shrink to {size}; give a whole fraction.")
    return by


def shrink(views: Views, by: int) -> Views:
    """The views at 1/by of their size: colours and alpha are averaged as light is, depth and motion, if known, over
    the surface nearest to the camera in each block."""
    if by == 1:
        return views
    height, width = (n // by for n in views.size)

    def blocks(x: Tensor) -> Tensor:  # (V,H,W,C) -> (V,h,w,by²,C)
        x = x[:, : height * by, : width * by].reshape(len(views), height, by, width, by, -1)
        return x.transpose(2, 3).flatten(3, 4)

    alpha = blocks(views.alpha[..., None])
    total = alpha.mean(3)
    rgb = (blocks(views.rgb) * alpha).mean(3) / total.clamp_min(1e-6)
    small = replace(views, rgb=rgb, alpha=total[..., 0], intrinsics=views.intrinsics / by, depth=None, flow=None)
    if views.depth is None or views.flow is None:
        return small
    depth, flow = blocks(views.depth[..., None]), blocks(views.flow)
    near = depth <= depth.amin(3, keepdim=True) + 0.05
    near &= torch.isfinite(depth)
    count = near.sum(3)
    mean = (torch.where(near, depth, 0.0).sum(3) / count.clamp_min(1))[..., 0]
    flow = torch.where(near, flow, 0.0).sum(3) / count.clamp_min(1) / by
    return replace(small, depth=torch.where(count[..., 0] > 0, mean, torch.inf), flow=flow)


def pad_to_multiple(views: Views, multiple: int) -> Views:
    """The views with empty pixels added on the right and below, so that both sides are multiples; cameras and
    what they see stay as they are."""
    height, width = views.size
    down, right = -height % multiple, -width % multiple
    if not down and not right:
        return views

    def pad(x: Tensor | None, value: float = 0.0) -> Tensor | None:
        sides = (0, 0) * (x.ndim - 3) + (0, right, 0, down) if x is not None else None
        return None if x is None else torch.nn.functional.pad(x, sides, value=value)

    return replace(
        views,
        rgb=pad(views.rgb),
        alpha=pad(views.alpha),
        depth=pad(views.depth, torch.inf),
        flow=pad(views.flow),
    )


def camera_rays(intrinsics: Tensor, height: int, width: int) -> Tensor:
    """intrinsics (V,4) -> (V,H,W,3) camera-space points at planar z = 1 below each pixel's centre."""
    fx, fy, cx, cy = intrinsics[:, :, None, None].unbind(1)
    y, x = torch.meshgrid(
        torch.arange(height, device=fx.device) + 0.5,
        torch.arange(width, device=fx.device) + 0.5,
        indexing="ij",
    )
    return torch.stack([(x - cx) / fx, (y - cy) / fy, torch.ones_like(fx) * torch.ones_like(x)], -1)


def rays(c2w: Tensor, intrinsics: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
    """c2w (V,4,4), intrinsics (V,4) -> ray origins (V,H,W,3) and unit directions (V,H,W,3), world space."""
    direction = torch.einsum("vij,vhwj->vhwi", c2w[:, :3, :3], camera_rays(intrinsics, height, width))
    direction = torch.nn.functional.normalize(direction, dim=-1)
    return c2w[:, None, None, :3, 3].expand_as(direction), direction


def pluecker(origin: Tensor, direction: Tensor) -> Tensor:
    """(…,3), (…,3) unit -> (…,6): direction, and the ray's point closest to the origin (paper, 2.2)."""
    nearest = origin - (origin * direction).sum(-1, keepdim=True) * direction
    return torch.cat([direction, nearest], -1)
