# SPDX-License-Identifier: GPL-3.0-or-later
"""Contracted space is the same space, and points are found where other views see the same colours."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from timesplat.datagen.rigs import spherical
from timesplat.datagen.sequence import opengl_to_opencv
from timesplat.model.geometry.surroundings import FARTHEST, contracted, expanded, is_whole, points_around
from timesplat.model.views import Views, rays


@given(st.lists(st.floats(-25, 25), min_size=3, max_size=3))
def test_there_and_back(place):
    place = torch.tensor([place], dtype=torch.float64)
    inside = contracted(place)
    again, larger = expanded(inside)
    assert inside.norm() <= 2 and torch.allclose(again, place, rtol=1e-9, atol=1e-9)
    r = float(place.norm())
    assert float(larger) == pytest.approx(max(1.0, r / (2 - 1 / r)) if r > 1 else 1.0)


def test_what_leaves_the_ball_stays_finite():
    places, larger = expanded(torch.tensor([[3.0, 0, 0], [0, 0, 0]]))
    assert torch.isfinite(places).all() and torch.isfinite(larger).all() and places[0, 0] <= 3 * FARTHEST


def room(size=96, half=6.0) -> Views:
    """A box of walls around 24 cameras that look inwards past each other, coloured by place: nothing else."""
    poses = np.stack([spherical(15 * i, 10 + 20 * (i % 2), 1.2) for i in range(24)])
    c2w = torch.from_numpy(opengl_to_opencv(poses)).float()
    camera = torch.tensor([[size, size, size / 2, size / 2]], dtype=torch.float32).expand(24, 4)
    origin, direction = rays(c2w, camera, size, size)
    distance = ((half * direction.sign() - origin) / direction).amin(-1, keepdim=True)
    walls = origin + distance * direction
    rgb = 0.5 + 0.5 * torch.sin(0.9 * walls + torch.tensor([0.0, 1, 2]))
    return Views(rgb, torch.ones(24, size, size), c2w, camera.clone(), torch.zeros(24), 2.0)


def test_points_lie_on_walls_far_outside():
    views = room()
    assert is_whole(views)
    views.alpha[:, :, :24] = 0
    assert not is_whole(views)
    views.alpha[:] = 1
    points, colours = points_around(views, 800, torch.Generator().manual_seed(0))
    places, _ = expanded(points)
    off = (places.abs().amax(-1) - 6.0).abs()
    assert off.median() < 0.8 and (places.norm(dim=-1) > 3).float().mean() > 0.8
    assert colours.shape == (800, 3) and (points.norm(dim=-1) < 2).all()
