# SPDX-License-Identifier: GPL-3.0-or-later
"""Patches of images: which of them become tokens, and the pixels of those, in the order of the network's Gaussians."""

from __future__ import annotations

import torch
from torch import Tensor

from .views import Views, rays


def in_patches(m: Tensor, p: int) -> Tensor:
    """m (V,H,W,…) with H and W multiples of p -> (V, H/p, p, W/p, p, …), a view."""
    return m.unflatten(2, (-1, p)).unflatten(1, (-1, p))


def gather_pixels(m: Tensor, keep: Tensor, p: int) -> Tensor:
    """m (V,H,W,…), keep (P,) bool with T patches kept -> (T, p², …): patches view by view and row by row, pixels
    row by row within; the order of the network's Gaussians."""
    m = in_patches(m, p)
    view, i, j = keep.reshape(len(m), m.shape[1], m.shape[3]).nonzero(as_tuple=True)
    return m[view, i, :, j].flatten(1, 2)


def patch_rays(views: Views, keep: Tensor, p: int) -> tuple[Tensor, Tensor]:
    """keep (P,) bool with T patches kept -> origins and unit directions (T,p²,3) of their pixels' rays, world: every
    patch is a small image of its own."""
    height, width = views.size
    view, i, j = keep.reshape(len(views), height // p, width // p).nonzero(as_tuple=True)
    corner = torch.stack([0 * i, 0 * i, j * p, i * p], -1)
    found = rays(views.c2w[view], views.intrinsics[view] - corner, p, p)
    return tuple(m.flatten(1, 2) for m in found)


def pixel_places(views: Views, keep: Tensor, p: int) -> Tensor:
    """keep (P,) bool -> (V·H·W,) for every pixel its place among the pixels of the kept patches, in the order of
    `gather_pixels`; -1 where it is not among them."""
    height, width = views.size
    number = torch.arange(len(views) * height * width, device=keep.device).reshape(len(views), height, width)
    place = torch.full_like(number.flatten(), -1)
    chosen = gather_pixels(number, keep, p).flatten()
    place[chosen] = torch.arange(len(chosen), device=keep.device)
    return place
