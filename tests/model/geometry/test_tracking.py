# SPDX-License-Identifier: GPL-3.0-or-later
"""Tracks of single points: how long they last, what ends them, and how they are cut."""

import pytest
import torch

from timesplat.model.geometry.lift import lift
from timesplat.model.geometry.scene_flow import SurfacePoints
from timesplat.model.geometry.tracking import MAX_PIECES, track_points
from timesplat.model.views import camera_rays

FRAMES = list(range(24))


def seen(views):
    """The points that views of frontal spheres show, and what their pixels say, as the lift prepares them."""
    valid = views.alpha > 0.5
    view = valid.nonzero()[:, 0]
    R, depth = views.c2w[view, :3, :3], views.depth[valid]
    ray = camera_rays(views.intrinsics, *views.size)[valid]
    place = (R @ (ray * depth[:, None])[..., None])[..., 0] + views.c2w[view, :3, 3]
    to_next, to_previous = views.flow[valid].split(2, -1)
    pixel = depth / views.intrinsics[view, 0]
    points = SurfacePoints(view, place, -R[..., 2], pixel, to_next, to_previous, depth, ray[:, :2])
    observed = torch.full_like(views.alpha, torch.inf)
    observed[valid] = depth
    return points, observed


def test_a_side_seen_often_lives_shorter(spheres):
    often = lift(spheres(FRAMES)).sigma_t.median()
    seldom = lift(spheres(FRAMES[::3], [(90 * i, 0) for i in range(8)])).sigma_t.median()
    assert seldom > 1.5 * often


def test_pieces_join_to_tracks_and_cover_what_is_needed(spheres):
    views = spheres(FRAMES)
    points, observed = seen(views)
    pieces, point, summary = track_points(views, points, observed)
    n = len(points.view)
    assert (torch.diff(point) >= 0).all() and point.unique().tolist() == list(range(n))
    assert torch.bincount(point).max() <= MAX_PIECES
    begin, end = pieces.time - pieces.half_length, pieces.time + pieces.half_length
    same = torch.diff(point) == 0
    torch.testing.assert_close(end[:-1][same], begin[1:][same], atol=1e-4, rtol=0)
    own = (views.time / views.frame_step)[points.view]
    first = torch.full((n,), torch.inf).scatter_reduce(0, point, begin, "amin")
    last = torch.full((n,), -torch.inf).scatter_reduce(0, point, end, "amax")
    torch.testing.assert_close(own - first, summary.frames_before.clamp_min(0.3), atol=1e-4, rtol=0)
    torch.testing.assert_close(last - own, summary.frames_after.clamp_min(0.3), atol=1e-4, rtol=0)


def test_one_view_alone_is_followed_to_the_end_of_what_is_known(spheres):
    """Nobody else sees the points: none agrees, none contradicts, and they live as long as points are followed."""
    views = spheres([12])
    *_, summary = track_points(views, *seen(views))
    assert not summary.agreeing_views.any() and not summary.contradicted.any()
    for frames in (summary.frames_before, summary.frames_after):
        assert frames.tolist() == pytest.approx([8.3] * len(frames))


def test_a_view_that_looks_through_a_point_ends_its_track(spheres):
    """The second view is of the same camera, one frame later, and shows nothing at all."""
    views = spheres([12, 13], [(0, 0), (0, 0)])
    points, observed = seen(views)
    observed[1] = torch.inf
    _, _, summary = track_points(views, points, observed)
    first = points.view == 0
    assert (summary.contradicted[first] == 1).all()
    assert summary.frames_after[first].tolist() == pytest.approx([0.3] * int(first.sum()))
    agreed = track_points(views, *seen(views)).summary
    assert agreed.contradicted[first].mean() < 0.2
    assert agreed.frames_after[first].median() == pytest.approx(0.45) and agreed.agreeing_views[first].median() == 1
