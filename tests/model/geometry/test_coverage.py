# SPDX-License-Identifier: GPL-3.0-or-later
"""Coverage of boxes whose seen and unseen sides are known."""

import numpy as np
import pytest
import torch

from timesplat.datagen.rigs import spherical
from timesplat.datagen.sequence import focal_from_fov, opengl_to_opencv
from timesplat.model.geometry.coverage import coverage, sphere_cameras, unseen_space
from timesplat.model.geometry.lift import lift
from timesplat.model.views import Views, rays

HALF = torch.tensor([0.5, 0.4, 0.6])
SIDES = [(0, 0), (90, 0), (180, 0), (270, 0)]


def hit(c2w, intrinsics, size):
    """The box, ray-traced: (V,H,W) distance along the unit ray (inf beside it) and the axis 0..2 of the side met."""
    origin, direction = rays(c2w, intrinsics, size, size)
    near = (-torch.sign(direction) * HALF - origin) / direction
    far = (torch.sign(direction) * HALF - origin) / direction
    distance, side = near.max(-1)
    return torch.where(distance < far.amin(-1), distance, torch.inf), side, direction


def box(cameras, size=64):
    """Views of the box, one camera a frame."""
    c2w = torch.tensor(np.stack([opengl_to_opencv(spherical(*c)) for c in cameras]), dtype=torch.float32)
    K = torch.tensor([[focal_from_fov(50, size)] * 2 + [size / 2] * 2]).expand(len(c2w), 4)
    distance, side, direction = hit(c2w, K, size)
    depth = distance * (direction * c2w[:, None, None, :3, 2]).sum(-1)
    rgb = torch.eye(3)[side]
    n = len(cameras)
    views = Views(rgb, torch.isfinite(depth).float(), c2w, K, torch.linspace(-1, 1, n), 2 / max(n - 1, 1))
    views.depth, views.flow = depth, torch.zeros(*depth.shape, 4)
    return views


def test_what_four_level_cameras_do_not_see_of_a_box():
    """Its top and bottom: that share of all that cameras around it see, known from ray tracing them."""
    views = box(SIDES)
    found, per_time = coverage(lift(views), views)
    c2w = sphere_cameras(12)
    distance, side, _ = hit(c2w, torch.tensor([[focal_from_fov(50, 64)] * 2 + [32, 32]]).expand(12, 4), 64)
    truth = float((side[distance < 9] != 2).float().mean())
    assert 0.6 < truth < 0.8
    assert found == pytest.approx(truth, abs=0.03)
    assert per_time.shape == (3,) and float(per_time.std()) < 0.02  # nothing moves


def test_a_box_seen_from_all_around_is_covered():
    views = box([*SIDES, (0, 89), (90, -89)])
    views.time[:] = 0  # all at one moment
    found, _ = coverage(lift(views), views, moments=1)
    assert found > 0.98


def test_one_view_covers_what_it_sees():
    one, two = box(SIDES[:1]), box(SIDES[:2])
    a, b = (coverage(lift(v), v, moments=1)[0] for v in (one, two))
    assert a < b - 0.1 < 0.6


def test_silhouettes_alone_leave_the_visual_hull():
    """Without depth all within the outlines is unseen, with depth all behind the surfaces."""
    views = box([*SIDES, (0, 89)])
    deep = unseen_space(views, 0.0).xyz
    views.depth = None
    hull = unseen_space(views, 0.0).xyz
    assert 0 < len(deep) < len(hull)
    assert (deep.abs() < HALF + 1e-6).all(dim=-1).float().mean() > 0.9
    assert (hull.abs() < HALF + 0.2).all()


def test_an_empty_scene_has_no_coverage():
    views = box(SIDES)
    views.alpha = torch.zeros_like(views.alpha)
    assert coverage(lift(views), views)[0] == 0
