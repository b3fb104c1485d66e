# SPDX-License-Identifier: GPL-3.0-or-later
"""Paths: interpolation against the definition by hand, windows, and what rides on them."""

from dataclasses import replace

import numpy as np
import pytest

from timesplat.datagen.sequence import InputError
from timesplat.model.io.asset import STATIC_SIGMA_T, Asset, check, rotation_matrices
from timesplat.model.io.paths import Paths, continuous, inverse, multiply, rotate

from ...assets import tracked_asset

RNG = np.random.default_rng(0)


def quaternions(n):
    q = RNG.normal(size=(n, 4))
    return (q / np.linalg.norm(q, axis=1, keepdims=True)).astype(np.float32)


def three() -> Paths:
    """One that stands still, a straight one for half of the clip, and one of four knots."""
    q = quaternions(7)
    for i in range(1, 7):
        q[i] *= 1 if q[i] @ q[i - 1] >= 0 else -1
    return Paths(
        np.array([-1, -0.5, -1], np.float32),
        np.array([1, 0.5, 1], np.float32),
        np.array([1, 2, 4], np.int32),
        RNG.normal(size=(7, 3)).astype(np.float32),
        q,
    )


def riding(paths: Paths, n=6) -> Asset:
    path = np.arange(n, dtype=np.int32) % 3
    xyz, t = RNG.normal(size=(n, 3)).astype(np.float32), np.linspace(-0.5, 0.5, n).astype(np.float32)
    one = np.ones(n, np.float32)
    zero, grey = np.zeros((n, 3), np.float32), np.full((n, 3), 0.5, np.float32)
    sigma_t, opacity = STATIC_SIGMA_T * one, 0.5 * one
    return Asset(xyz, t, zero, sigma_t, 0.1 * grey, quaternions(n), grey, opacity, path=path, paths=paths)


def test_between_knots_by_hand():
    p = three()
    place, turn = p.at(-1 / 3 + 0.25 * 2 / 3)  # a quarter of the way from the second knot of four to the third
    assert np.allclose(place[0], p.place[0]) and np.allclose(turn[0], p.rotation[0])
    assert np.allclose(place[2], 0.75 * p.place[4] + 0.25 * p.place[5], atol=1e-6)
    mixed = 0.75 * p.rotation[4] + 0.25 * p.rotation[5]
    assert np.allclose(turn[2], mixed / np.linalg.norm(mixed), atol=1e-6)
    for time, row in ((-2.0, 1), (-0.5, 1), (0.5, 2), (2.0, 2)):
        assert np.allclose(p.at(time)[0][1], p.place[row]), time


def test_each_at_its_own_time():
    p, rows, times = three(), np.array([2, 0, 2, 1]), np.array([-0.9, 0.3, 0.7, 0.1], np.float32)
    place, turn = p.at(times, rows)
    for i, (row, time) in enumerate(zip(rows, times, strict=True)):
        assert np.allclose(place[i], p.at(time)[0][row]) and np.allclose(turn[i], p.at(time)[1][row])


def test_windows():
    p = three()
    assert p.there(-0.5).all() and p.there(0.5).all() and list(p.there(0.51)) == [True, False, True]


def test_rows():
    p = three()
    q = p[np.array([2, 1])]
    assert list(q.count) == [4, 2] and np.array_equal(q.place, p.place[[3, 4, 5, 6, 1, 2]])
    for time in (-1, 0.2, 0.9):
        assert np.array_equal(q.at(time)[0], p.at(time)[0][[2, 1]])
    assert np.array_equal(p[np.array([False, True, True])].place, p.place[1:])


def test_what_rides_keeps_its_place_in_the_moving_frame():
    a = riding(three())
    check(a)
    for i in range(len(a)):  # at its own time it is where it says
        xyz, _ = a.at(float(a.t[i]))
        assert np.allclose(xyz[i], a.xyz[i], atol=1e-6)
        assert abs(a.rotation_at(float(a.t[i]))[i] @ a.rotation[i]) == pytest.approx(1, abs=1e-6)
    offset, local = a.on_path()
    for time in (-1.0, -0.1, 0.77):
        place, turn = (x[a.path] for x in a.paths.at(time))
        R = rotation_matrices(turn)
        assert np.allclose(a.at(time)[0], place + (R @ offset[..., None])[..., 0], atol=1e-5)
        assert np.allclose(rotation_matrices(a.rotation_at(time)), R @ rotation_matrices(local), atol=1e-5)
    assert list(a.at(0.9)[1]) == [0.5, 0, 0.5, 0.5, 0, 0.5]


def test_rows_of_an_asset_take_their_paths_along():
    a = riding(three())
    b = a[np.array([2, 5, 0])]
    assert len(b.paths) == 2 and list(b.path) == [1, 1, 0]
    assert np.allclose(b.at(0.3)[0], a.at(0.3)[0][[2, 5, 0]], atol=1e-6)
    check(b)


def test_wrong_paths_are_refused():
    a = riding(three())
    for wrong, said in (
        ({"path": a.path + 1}, "not there"),
        ({"path": None}, "not there"),
        ({"paths": replace(a.paths, place=a.paths.place[:-1])}, "place"),
        ({"paths": replace(a.paths, rotation=2 * a.paths.rotation)}, "unit length"),
        ({"paths": replace(a.paths, end=a.paths.start)}, "end before"),
        ({"paths": replace(a.paths, count=a.paths.count.astype(float))}, "place|start"),
    ):
        with pytest.raises(InputError, match=said):
            check(replace(a, **wrong))


def test_more_paths_than_a_file_can_number_are_refused(monkeypatch):
    monkeypatch.setattr("timesplat.model.io.asset.MAX_GAUSSIANS", 2)
    with pytest.raises(InputError, match="more than 2 paths"):
        check(riding(three()))


def test_quaternions_against_matrices():
    a, b, v = quaternions(9), quaternions(9), RNG.normal(size=(9, 3))
    A, B = rotation_matrices(a), rotation_matrices(b)
    assert np.allclose(rotation_matrices(multiply(a, b)), A @ B, atol=1e-5)
    assert np.allclose(rotate(a, v), (A @ v[..., None])[..., 0], atol=1e-5)
    assert np.allclose(rotate(inverse(a), rotate(a, v)), v, atol=1e-5)


def test_signs_that_lead_the_shorter_way():
    q, count = quaternions(9), np.array([1, 5, 3])
    turned = continuous(q, count)
    assert np.array_equal(np.abs(turned), np.abs(q)) and np.array_equal(turned[[0, 1, 6]], q[[0, 1, 6]])
    for i, j in ((1, 6), (6, 9)):
        assert ((turned[i + 1 : j] * turned[i : j - 1]).sum(1) >= 0).all()
    assert np.array_equal(continuous(turned, count), turned)


def test_velocities_at_own_times():
    """Against smaller steps where the path goes on as it does, and at its ends, where there is one side alone."""
    a = tracked_asset(40, (2, 2), turn=0)
    want = (a.paths.place[1::2] - a.paths.place[::2]) / (a.paths.end - a.paths.start)[:, None]
    for t in (a.t, a.paths.start[a.path], a.paths.end[a.path]):
        b = replace(a, t=t, xyz=a.xyz.copy())
        assert np.allclose(b.path_velocity(), want[a.path], atol=1e-5)
    b = tracked_asset(40, (7,))
    half = 1 / (len(b.clip.frames) - 1)
    for i in np.flatnonzero(np.abs(b.t) < 0.9):
        way = b.at(float(b.t[i]) + half)[0][i] - b.at(float(b.t[i]) - half)[0][i]
        assert np.allclose(b.path_velocity()[i], way / (2 * half), atol=1e-4)
