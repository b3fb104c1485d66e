# SPDX-License-Identifier: GPL-3.0-or-later
"""Tracks of surface points, as they start: where they are, in which colours, on how many paths."""

import math
from dataclasses import replace

import numpy as np
import torch

from tests.model import track_scenes as scenes
from timesplat.model.geometry.surface_tracks import needed_points, surface_tracks


def test_points_are_where_they_were_and_share_a_path():
    seen = scenes.views()
    tracks = surface_tracks(seen.surface, seen)
    pixel = seen.pixel
    assert len(tracks) == len(seen.surface) == 600 and len(tracks.paths) <= 8
    centre, _ = scenes.motion()
    for f in (0, 4, 8):
        away = (tracks.at(2 * f / 8 - 1).xyz - centre[f]).norm(dim=-1)
        assert float((away - scenes.RADIUS).abs().max()) < 1.2 * pixel  # below the surface, but not by more


def test_the_start_already_looks_like_it():
    seen = scenes.views()
    tracks, others = surface_tracks(seen.surface, seen), scenes.views(9, seed=5)
    white = 10 * math.log10(1 / float((1 - others.over()).square().mean()))
    assert scenes.psnr(tracks, others) > white + 5
    normal = scenes.sphere_points(600)
    right = (tracks.rgb - scenes.pattern(normal)).abs().amax(-1) < 0.25
    assert right.float().mean() > 0.6  # the others lie on the edges of bands


def test_what_no_view_sees_takes_the_colour_of_its_neighbour():
    above = scenes.views()[torch.tensor([0, 9])]  # two views of one moment
    tracks = surface_tracks(above.surface, above)
    assert len(tracks) == 600 and torch.isfinite(tracks.rgb).all()
    assert float((tracks.rgb.min(-1).values).max()) < 0.6  # none is white or grey, that is invented


def test_a_sheet_has_two_sides():
    """The same points with a colour by side: seen from above red, from below blue."""
    seen = scenes.views(24, elevation=80)
    n = 100
    grid = torch.stack(torch.meshgrid(*2 * [torch.linspace(-0.5, 0.5, 10)], indexing="ij"), -1).reshape(-1, 2)
    position = torch.cat([grid, torch.zeros(n, 1)], -1)[:, None].expand(n, scenes.FRAMES, 3)
    turn = torch.tensor([1.0, 0, 0, 0]).expand(n, scenes.FRAMES, 4)
    sheet = replace(
        scenes.surface(n),
        position=position.numpy().astype(np.float32).copy(),
        rotation=turn.numpy().astype(np.float16).copy(),
    )
    above = seen.c2w[:, 2, 3] > 0
    side = torch.where(above[:, None], torch.tensor([1.0, 0, 0]), torch.tensor([0, 0, 1.0]))
    seen.rgb = side[:, None, None].expand_as(seen.rgb).clone()
    ray = torch.stack([scenes._rays(c) for c in seen.c2w])
    depth = -seen.c2w[:, 2, 3, None, None] / ray[..., 2]
    at = seen.c2w[:, None, None, :2, 3] + depth[..., None] * ray[..., :2]
    seen.depth = torch.where((at.abs().amax(-1) < 0.55) & (depth > 0), depth, torch.inf)
    seen.alpha = torch.isfinite(seen.depth).float()
    tracks = surface_tracks(sheet, seen)
    z = tracks.at(0.0).xyz[:, 2]
    assert len(tracks) == 2 * n
    assert (tracks.rgb[z > 0, 0] > 0.9).all() and (tracks.rgb[z < 0, 2] > 0.9).all()


def test_as_many_as_pixels_need_or_as_are_wanted():
    seen = scenes.views()
    many = scenes.surface(9000)
    whole = float(many.area.sum())
    assert needed_points(many, seen) == 4000 > whole / seen.pixel**2
    assert len(surface_tracks(many, seen, 50)) == 50
    big = replace(seen, intrinsics=seen.intrinsics * 4)
    assert needed_points(many, big) == min(9000, round(whole / big.pixel**2))


def test_what_fills_few_pixels_is_kept():
    """Points that lie more densely than pixels share what is seen of them, and what is faint is left out."""
    seen, many = scenes.views(), scenes.surface(9000)
    pixels = float(many.area.sum()) / seen.pixel**2
    tracks = surface_tracks(replace(many, area=many.area * np.float32(200 / pixels)), seen, 5000)
    assert 500 < len(tracks) <= 800 and tracks.alive().all()


def test_nothing_followed_makes_nothing():
    seen = scenes.views(2)
    none = replace(scenes.surface(1), **{k: v[:0] for k, v in vars(scenes.surface(1)).items()})
    assert len(surface_tracks(none, seen)) == 0
