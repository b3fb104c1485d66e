# SPDX-License-Identifier: GPL-3.0-or-later
"""Cameras to rays, checked by projecting back, padding that changes nothing that is seen, and smaller pictures."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from timesplat.datagen.sequence import InputError, read_sequence
from timesplat.model.geometry.lift import lift
from timesplat.model.reconstruct import reconstruct_views
from timesplat.model.views import load_views, pad_to_multiple, pluecker, rays, shrink


def test_rays_project_back_to_their_pixels(spheres):
    views = spheres([0, 5], [(30, 20), (200, -15)], size=16)
    views.intrinsics[:, 2] += 1.5  # off-centre
    origin, direction = rays(views.c2w, views.intrinsics, 16, 16)
    torch.testing.assert_close(direction.norm(dim=-1), torch.ones(2, 16, 16))
    w2c = torch.linalg.inv(views.c2w)
    p = origin + 1.7 * direction
    local = torch.einsum("vij,vhwj->vhwi", w2c[:, :3, :3], p) + w2c[:, None, None, :3, 3]
    K = views.intrinsics[:, None, None]
    pixel = local[..., :2] / local[..., 2:] * K[..., :2] + K[..., 2:]
    y, x = np.mgrid[:16, :16] + 0.5
    torch.testing.assert_close(pixel, torch.tensor(np.stack([x, y], -1)).float().expand_as(pixel), atol=1e-4, rtol=0)


def test_pluecker_is_direction_and_the_point_nearest_to_the_origin(spheres):
    views = spheres([0], [(30, 20)], size=16)
    origin, direction = rays(views.c2w, views.intrinsics, 16, 16)
    P = pluecker(origin, direction)
    nearest = P[..., 3:]
    assert torch.equal(P[..., :3], direction)
    assert (nearest * direction).sum(-1).abs().max() < 1e-5  # perpendicular, …
    along = (nearest - origin) - ((nearest - origin) * direction).sum(-1, keepdim=True) * direction
    assert along.norm(dim=-1).max() < 1e-5  # … and on the ray


def test_loading_keeps_colours_cameras_and_times(spheres, sphere_folder):
    seq = read_sequence(sphere_folder)
    loaded, made = load_views(seq, range(24), has_depth=True), spheres(list(range(24)), size=32)
    assert (loaded.rgb - made.rgb).abs().max() <= 0.5 / 255 + 1e-6
    for k in ("alpha", "depth", "time", "c2w", "intrinsics"):
        torch.testing.assert_close(getattr(loaded, k), getattr(made, k), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(loaded.flow, made.flow, atol=5e-3, rtol=1e-3)
    assert loaded.frame_step == made.frame_step


def test_padding_changes_nothing_that_is_seen(spheres):
    views = spheres([0, 1, 2, 3], size=30)
    padded = pad_to_multiple(views, 8)
    assert padded.size == (32, 32) and pad_to_multiple(padded, 8) is padded
    torch.testing.assert_close(lift(views).xyz, lift(padded).xyz, atol=1e-6, rtol=0)
    assert len(reconstruct_views(views, "guided")) == len(lift(views))


def test_shrinking_averages_light_and_keeps_the_nearest_surface(spheres):
    views = spheres([0, 5], size=32)
    half = shrink(views, 2)
    assert half.size == (16, 16)
    blocks = views.over(0.0).reshape(2, 16, 2, 16, 2, 3).mean((2, 4))
    torch.testing.assert_close(half.over(0.0), blocks, atol=1e-6, rtol=0)
    exact = spheres([0, 5], size=16)
    both = torch.isfinite(exact.depth) & torch.isfinite(half.depth)
    assert (half.depth - exact.depth)[both].abs().median() < 0.02
    assert (half.flow - exact.flow)[both].abs().median() < 0.02
    torch.testing.assert_close(half.intrinsics, exact.intrinsics)
    blind = shrink(replace(views, depth=None, flow=None), 2)
    assert blind.depth is None and torch.equal(blind.rgb, half.rgb)


def test_views_are_made_smaller_as_they_are_read(sphere_folder):
    seq = read_sequence(sphere_folder)
    whole, half = load_views(seq, range(6), True), load_views(seq, range(6), True, 16)
    small = shrink(whole, 2)
    assert half.size == (16, 16) and half.frame_step == whole.frame_step
    for k in ("rgb", "alpha", "c2w", "intrinsics", "time", "depth", "flow"):
        torch.testing.assert_close(getattr(half, k), getattr(small, k), atol=1e-6, rtol=0)
    pictures = load_views(seq, range(6), size=16)
    assert pictures.depth is None and torch.equal(pictures.rgb, half.rgb)
    seq.width = 64  # the longer side counts
    with pytest.raises(InputError, match="64x32 pixels do not shrink to 24; give a whole fraction"):
        load_views(seq, [0], size=24)
    for size in (0, -16, 5, 128):
        with pytest.raises(InputError, match=f"do not shrink to {size};"):
            load_views(seq, [0], size=size)
