# SPDX-License-Identifier: GPL-3.0-or-later
"""Views for fits: averaged down as light is, spread over the clip, and drawn from all around."""

import pytest
import torch

from timesplat.model.fitting.fit_views import (
    VALIDATION_VIEWS,
    detached,
    downsampled,
    joined,
    psnr,
    reduction,
    set_aside,
    squared_error,
    validation_views,
    views_around,
)
from timesplat.model.geometry.lift import lift


@pytest.fixture(scope="module")
def inputs(spheres):
    return spheres(list(range(24)), size=48)


def test_smaller_pictures_are_the_same_seen_smaller(spheres):
    large, small = spheres([5], [(30, 20)], size=96), spheres([5], [(30, 20)], size=32)
    got = downsampled(large, 3)
    assert got.size == (32, 32) and downsampled(large, 1) is large
    torch.testing.assert_close(got.intrinsics, small.intrinsics)
    torch.testing.assert_close(got.over(1.0).mean((0, 1, 2)), large.over(1.0).mean((0, 1, 2)))
    assert (got.over(1.0) - small.over(1.0)).abs().mean() < 0.02
    assert downsampled(spheres([5], size=50), 4).size == (13, 13)
    assert reduction(large, 32) == reduction(large, 47) == 3 and reduction(large, 200) == 1


def test_copies_are_free_of_inference_mode(inputs):
    with torch.inference_mode():
        views = inputs[:2]
        views.rgb = views.rgb + 0
        with torch.inference_mode(False):
            copy = detached(views)
    assert views.rgb.is_inference() and not copy.rgb.is_inference() and copy.depth is None
    both = joined(copy, detached(inputs[5:6]))
    assert len(both) == 3 and torch.equal(both.time, inputs.time[[0, 1, 5]])


def test_validation_views_are_spread_over_the_clip(inputs):
    assert validation_views(inputs).tolist() == [3, 9, 15, 21] and len(validation_views(inputs)) == VALIDATION_VIEWS
    assert validation_views(inputs[:3]).tolist() == [0, 1, 2] and validation_views(inputs[:1]).tolist() == [0]


def test_a_quarter_of_the_views_is_set_aside_six_at_the_most(inputs):
    for count, aside in ((24, 6), (12, 3), (4, 1), (2, 1)):
        kept, held = set_aside(inputs[:count])
        assert len(held) == aside and len(kept) == count - aside
        assert torch.equal(torch.cat([kept.time, held.time]).sort().values, inputs.time[:count].sort().values)
    kept, held = set_aside(inputs[:1])
    assert len(kept) == len(held) == 1


def test_pictures_from_around_are_what_the_gaussians_look_like(inputs):
    g = lift(inputs)
    views = views_around(g, inputs, seed=3, count=5)
    assert len(views) == 5 and views.size == inputs.size
    assert all((inputs.time - t).abs().min() < 1e-5 for t in views.time)
    between = views_around(g, inputs[[4, 12]], seed=3, count=60).time  # frames that no view shows
    assert (
        between.unique().numel() > 5
        and between.min() >= inputs.time[4] - 1e-5
        and between.max() <= inputs.time[12] + 1e-5
    )
    assert views_around(g, inputs[[4]], count=3).time.tolist() == [float(inputs.time[4])] * 3
    assert squared_error(g, views) < 1e-6  # over white, as they were drawn
    assert 60 < psnr(g, views) <= 100 and psnr(g[:0], views) < 30
    torch.testing.assert_close(views.c2w[:, :3, 3].norm(dim=-1), inputs.c2w[:5, :3, 3].norm(dim=-1))
    torch.testing.assert_close(torch.linalg.det(views.c2w[:, :3, :3]), torch.ones(5))
    torch.testing.assert_close(views_around(g, inputs, seed=3, count=5).rgb, views.rgb)
    assert (views_around(g, inputs, seed=4, count=5).c2w - views.c2w).abs().max() > 0.1
