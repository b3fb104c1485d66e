# SPDX-License-Identifier: GPL-3.0-or-later
import numpy as np
import pytest

from timesplat.datagen.spread import spread

UP = np.array([0, 0, 1.0])


def plane(n, seed=0):
    return np.concatenate([np.random.default_rng(seed).random((n, 2)), np.zeros((n, 1))], 1)


def chosen(points, count, normals=None, group=None, area=1.0):
    n = len(points)
    normals = np.tile(UP, (n, 1)) if normals is None else normals
    group = np.zeros(n, int) if group is None else group
    which = spread(points, normals, group, area, count, np.random.default_rng(0))
    assert len(which) == min(count, n) and (np.diff(which) > 0).all()
    return which


def closest(points):
    d = np.linalg.norm(points[:, None] - points[None], axis=-1)
    np.fill_diagonal(d, np.inf)
    return d.min(1)


@pytest.mark.parametrize("count", [50, 1000])
def test_none_are_close_and_no_hole_is_left(count):
    points = plane(4 * count)
    some = points[chosen(points, count)]
    spacing = 1 / np.sqrt(count)
    assert closest(some).min() > 0.55 * spacing
    inside = np.abs(points[:, :2] - 0.5).max(1) < 0.5 - spacing
    gaps = np.linalg.norm(points[inside][:, None] - some[None], axis=-1).min(1)
    assert gaps.max() < 1.2 * spacing


def test_others_and_the_other_side_do_not_count():
    points = np.repeat(plane(4000), 2, 0)
    flip = np.where(np.arange(8000) % 2, 1, -1)[:, None]
    for normals, group in ((UP * flip, None), (None, np.arange(8000) % 2)):
        which = chosen(points, 2000, normals, group, area=2.0)
        for side in (0, 1):
            some = points[which[which % 2 == side]]
            assert 900 < len(some) < 1100 and closest(some).min() > 0.5 / np.sqrt(1000)


def test_few_points_and_points_in_a_heap():
    assert chosen(plane(5), 9).tolist() == [0, 1, 2, 3, 4]
    heap = np.concatenate([plane(400), np.zeros((5000, 3))])
    chosen(heap, 1000)
    chosen(np.zeros((3000, 3)), 1000)
