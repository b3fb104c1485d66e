# SPDX-License-Identifier: GPL-3.0-or-later
import numpy as np
import torch

from timesplat.datagen.rigs import spherical
from timesplat.datagen.sequence import opengl_to_opencv
from timesplat.model.gaussians import Gaussians4D
from timesplat.model.geometry.silhouettes import HALF_SIDE, points_inside
from timesplat.model.rasterize import render
from timesplat.model.views import Views


def ball_views(count=12, size=48, radius=0.2) -> Views:
    """Of an opaque red blob at (0.3, 0, 0)."""
    c2w = np.stack([spherical(360 * i / count, 40 * (-1) ** i, 2.7) for i in range(count)])
    c2w = torch.from_numpy(opengl_to_opencv(c2w)).float()
    intrinsics = torch.tensor([[size, size, size / 2, size / 2]]).expand(count, 4).float()
    one = torch.ones(1)
    blob = Gaussians4D(
        torch.tensor([[0.3, 0, 0]]), 0 * one, torch.zeros(1, 3), 1e4 * one, torch.full((1, 3), radius),
        torch.tensor([[1.0, 0, 0, 0]]), torch.tensor([[1.0, 0, 0]]), 0.99 * one,
    )  # fmt: skip
    time = torch.linspace(-1, 1, count)
    rgb, alpha = render(blob, c2w, intrinsics, time, size, size, background=0.0)
    return Views(rgb / alpha[..., None].clamp_min(1e-6), alpha, c2w, intrinsics, time, 2 / (count - 1))


def test_points_are_in_the_object_and_have_its_colour():
    xyz, rgb = points_inside(ball_views(), 500, torch.Generator().manual_seed(0))
    assert xyz.shape == rgb.shape == (500, 3)
    assert (xyz - torch.tensor([0.3, 0, 0])).norm(dim=-1).max() < 0.45  # half of alpha is at 1.2 σ
    assert (rgb - torch.tensor([1.0, 0, 0])).abs().max() < 0.1


def test_where_nothing_is_seen_they_are_anywhere():
    views = ball_views()
    views.alpha = torch.zeros_like(views.alpha)
    xyz, _ = points_inside(views, 300, torch.Generator().manual_seed(0))
    assert len(xyz) == 300 and xyz.abs().max() <= HALF_SIDE and xyz.std() > 0.5


def test_where_no_camera_looks_at_the_volume_they_are_anywhere():
    views = ball_views()
    views.intrinsics = views.intrinsics - torch.tensor([0.0, 0, 480, 0])
    assert len(points_inside(views, 300, torch.Generator().manual_seed(0))[0]) == 300


def test_what_lies_outside_of_half_of_the_frames_is_found_too():
    """Half of the cameras are turned so far that they see nothing of the object."""
    views = ball_views()
    turned = torch.arange(len(views)) % 2 == 1
    views.intrinsics = views.intrinsics - 10 * views.size[1] * turned[:, None] * torch.tensor([0.0, 0, 1, 0])
    views.alpha[turned] = 0.0
    xyz, _ = points_inside(views, 500, torch.Generator().manual_seed(0))
    assert (xyz - torch.tensor([0.3, 0, 0])).norm(dim=-1).max() < 0.45
