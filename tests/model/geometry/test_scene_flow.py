# SPDX-License-Identifier: GPL-3.0-or-later
"""The scene flow where there is one answer, and where there is none."""

import torch

from timesplat.model.geometry.scene_flow import EXTENT, GRID, FlowSettings, SurfacePoints, constraints, scene_flow


def test_scene_flow_is_exact_where_two_sides_see_one_motion(spheres):
    """Two perpendicular views of one rigid motion: the least squares have one answer."""
    views = spheres([5, 5], [(0, 0), (90, 0)])
    torch.manual_seed(0)
    n, turn = 400, torch.tensor([0.05, 0.02, -0.04])
    place, view = torch.rand(n, 3) * 0.2 + 0.1, torch.arange(n) % 2
    motion = torch.tensor([0.02, -0.01, 0.03]) + torch.linalg.cross(turn.expand(n, 3), place)
    w2c = torch.linalg.inv(views.c2w)[view]

    def project(p):
        local = (w2c[:, :3, :3] @ p[..., None])[..., 0] + w2c[:, :3, 3]
        return local[:, :2] / local[:, 2:], local[:, 2]

    ray, depth = project(place)
    f = views.intrinsics[0, 0]
    to_next, to_previous = ((project(place + k * motion)[0] - ray) * f for k in (1, -1))
    points = SurfacePoints(view, place, place, depth / f, to_next, to_previous, depth, ray)
    settings = FlowSettings(still=1e-6, unturned=1e-6)
    field = scene_flow(views, points, *constraints(views, points), 23, settings)
    cell = ((place / EXTENT + 1) * GRID / 2).long()
    v, spin = field[5][tuple(cell.T)].split(3, -1)
    torch.testing.assert_close(v + torch.linalg.cross(spin, place), motion, atol=1e-3, rtol=0)


def test_without_motion_vectors_nothing_moves(spheres):
    views = spheres([5])
    n = 6
    zero = torch.zeros(n, 2)
    index, one = torch.zeros(n, dtype=torch.long), torch.ones(n)
    points = SurfacePoints(index, torch.rand(n, 3), torch.rand(n, 3), one, zero, zero, one, zero)
    field = scene_flow(views, points, *constraints(views, points), 23)
    assert field.shape == (23, GRID, GRID, GRID, 6) and not field.any()
