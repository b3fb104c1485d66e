# SPDX-License-Identifier: GPL-3.0-or-later
"""Where the object is, against objects whose place is known."""

import numpy as np
import pytest

from timesplat.datagen import rigs
from timesplat.datagen.readers import volume
from timesplat.datagen.sequence import InputError, opengl_to_opencv


def silhouettes(middle, radius, count=16, distance=3.0, size=64, windows=1, focal=70.0, moving=(0.0, 0.0, 0.0)):
    """Of a ball, from cameras in every direction around the origin; it has moved by `moving` in the last window."""
    c2w = np.stack([opengl_to_opencv(rigs.spherical(137.5 * k, 50 * np.sin(2.4 * k), distance)) for k in range(count)])
    y, x = np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5, indexing="ij")
    window = np.arange(count) * windows // count
    masks = []
    for k, m in enumerate(c2w):
        d = np.stack([(x - size / 2) / focal, (y - size / 2) / focal, np.ones_like(x)], -1) @ m[:3, :3].T
        o = m[:3, 3] - np.array(middle) - np.array(moving) * window[k] / max(windows - 1, 1)
        a, b = (d * d).sum(-1), (d * o).sum(-1)
        masks.append(b * b - a * (o @ o - radius**2) > 0)
    K = np.tile([focal, focal, size / 2, size / 2], (count, 1))
    return volume.Silhouettes(np.stack(masks), c2w, K, window)


def test_the_hull_holds_a_ball_and_little_more():
    sil = silhouettes((0.2, -0.1, 0.3), 0.5)
    hull = volume.hull_of(sil)
    low, high = hull.bounds()
    for found, truth in ((low, -0.5), (high, 0.5)):
        np.testing.assert_allclose(found - (0.2, -0.1, 0.3), truth, atol=0.09)
    assert np.nanmin(volume.agreement(sil, hull)) > 0.97


def test_of_a_moving_one_all_places_are_held():
    low, high = volume.hull_of(silhouettes((-0.4, 0, 0), 0.3, count=32, windows=2, moving=(0.8, 0, 0))).bounds()
    assert low == pytest.approx((-0.7, -0.3, -0.3), abs=0.1) and high == pytest.approx((0.7, 0.3, 0.3), abs=0.1)


def test_what_is_out_of_a_picture_is_no_part_of_what_it_shows_whole():
    """Four cameras around it see nothing of the places beside them; an object that no border cuts is not there."""
    sil = silhouettes((0, 0, 0), 0.6)
    for k in range(16):
        sil.c2w[k] = opengl_to_opencv(rigs.spherical(90 * k, 0, 3.0))
    low, high = volume.hull_of(sil).bounds()
    assert np.abs([low, high]).max() < 0.8


def test_wrong_cameras_have_no_hull_or_agree_less():
    sil = silhouettes((0.4, 0.2, -0.1), 0.5)
    wrong = volume.Silhouettes(sil.masks, sil.c2w * np.array([1, -1, -1, 1]), sil.intrinsics, sil.window)
    assert volume.hull_of(wrong) is None
    mirrored = volume.Silhouettes(sil.masks[:, :, ::-1], sil.c2w, sil.intrinsics, sil.window)
    hull = volume.hull_of(mirrored)
    assert hull is None or np.nanmean(volume.agreement(mirrored, hull)) < 0.8
    empty = volume.Silhouettes(sil.masks & False, sil.c2w, sil.intrinsics, sil.window)
    assert volume.hull_of(empty) is None


def test_which_views_are_looked_at():
    assert len(volume.chosen_views(np.zeros(500))[0]) == volume.STILL
    rig = volume.chosen_views(np.repeat(np.arange(100), 30))
    assert [len(w) for w in rig] == [volume.AT_ONCE] * volume.WINDOWS
    frames = np.repeat(np.arange(100), 30)
    assert all(len(np.unique(frames[w])) == 1 for w in rig) and frames[rig[-1][0]] == 99
    single = volume.chosen_views(np.arange(100)[::-1])
    assert len(single) == volume.WINDOWS and all(np.ptp(99 - w) <= 9 for w in single)


def test_the_point_that_rays_have_in_common():
    rng = np.random.default_rng(0)
    place = rng.normal(size=(9, 3))
    direction = np.array([3.0, 4, 5]) - place
    along = np.linalg.norm(direction, axis=1)
    centre, found = volume.common_point(place, direction / along[:, None])
    assert centre == pytest.approx((3, 4, 5)) and found == pytest.approx(along)
    assert volume.common_point(place, np.tile([0.0, 0, 1], (9, 1))) is None


def test_normalised_within_the_ball_and_the_box():
    n = volume.normalisation_around(np.array([1.0, 0, 0]), np.array([3.0, 1, 1]))
    assert n.translation == (2, 0.5, 0.5)
    assert n.scale == pytest.approx(volume.MARGIN * np.sqrt(1.5) / 1.1)  # its corners are what is farthest
    inner = volume.normalisation_around(np.array([1.0, 0, 0]), np.array([3.0, 1, 1]), np.array([[3.0, 0.5, 0.5]]))
    assert inner.scale == pytest.approx(volume.MARGIN)


def test_from_points_and_from_cameras_alone():
    sil = silhouettes((0, 0, 0), 0.5)
    sil.masks[:] = True
    rng = np.random.default_rng(0)
    near, far = rng.uniform(-0.4, 0.6, (500, 3)), rng.uniform(5, 9, (300, 3))
    box = volume.bounds_of_points(np.concatenate([near, far]), sil, 3.0, np.zeros(3))
    assert box[0] == pytest.approx([-0.4] * 3, abs=0.03) and box[1] == pytest.approx([0.6] * 3, abs=0.03)
    assert volume.bounds_of_points(far, sil, 3.0, np.zeros(3)) is None
    place, axis = sil.c2w[:, :3, 3], sil.c2w[:, :3, 2]
    n = volume.normalisation_of_views(place + 7, axis, np.full(16, 0.5), "file")
    assert n.scale == pytest.approx(1.5) and n.translation == pytest.approx((7, 7, 7))
    for direction, says in ((-axis, "look away"), (axis * 0 + (0, 0, 1), "all look the same way")):
        with pytest.raises(InputError, match=f"file: its cameras {says}"):
            volume.normalisation_of_views(place, direction, np.full(16, 0.5), "file")
