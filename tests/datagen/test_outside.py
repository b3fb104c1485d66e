# SPDX-License-Identifier: GPL-3.0-or-later
import numpy as np

from timesplat.datagen.outside import seen_from_outside


def ball(n, radius):
    k = np.arange(n)
    z, turn = 1 - (2 * k + 1) / n, k * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - z * z)
    return radius * np.stack([ring * np.cos(turn), ring * np.sin(turn), z], 1)


def spacing(n, radius):
    return np.sqrt(4 * np.pi / n) * radius


def test_what_is_inside_is_not_seen():
    outer, inner = ball(20_000, 1), ball(4_000, 0.8)
    seen = seen_from_outside(np.concatenate([outer, inner]), spacing(20_000, 1))
    assert seen[: len(outer)].all() and not seen[len(outer) :].any()


def test_through_an_opening_it_is():
    outer, inner = ball(20_000, 1), ball(4_000, 0.5)
    outer = outer[outer[:, 2] < 0.5]
    seen = seen_from_outside(np.concatenate([outer, inner]), spacing(20_000, 1))[len(outer) :]
    assert seen[inner[:, 2] > 0.4].all() and not seen[inner[:, 2] < -0.4].any()


def test_a_plane_is_seen_whole_and_nothing_is_nothing():
    x = np.linspace(-1, 1, 200)
    plane = np.stack([*np.meshgrid(x, x), np.zeros((200, 200))], -1).reshape(-1, 3)
    assert seen_from_outside(plane, 0.01).all() and len(seen_from_outside(plane[:0], 0.01)) == 0
    assert seen_from_outside(np.zeros((5, 3)), 0.01).all()
