# SPDX-License-Identifier: GPL-3.0-or-later
"""Lenses: the models against their formulas by hand, and pictures that come out straight."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from timesplat.datagen.readers.lenses import Lens, Taps, sample, straighten

from .worlds import inverse

LENS = Lens(48, 40, 50.0, 48.0, 25.3, 18.6)


def test_brown_by_hand():
    lens = replace(LENS, radial=(0.1, -0.05, 0.01), divisor=(0.2, 0.0, 0.0), tangential=(0.003, -0.002))
    x, y = 0.3, -0.4
    r2 = 0.25
    factor = (1 + 0.1 * r2 - 0.05 * r2**2 + 0.01 * r2**3) / (1 + 0.2 * r2)
    u = x * factor + 2 * 0.003 * x * y - 0.002 * (r2 + 2 * x * x)
    v = y * factor + 0.003 * (r2 + 2 * y * y) - 2 * 0.002 * x * y
    got = lens.pixels(np.array(x), np.array(y))
    assert got[:2] == pytest.approx((50 * u + 25.3, 48 * v + 18.6), abs=1e-12) and got[2]


def test_fisheye_by_hand():
    lens = replace(LENS, radial=(0.1, 0.02), fisheye=True)
    theta = math.atan(0.5)
    far = theta * (1 + 0.1 * theta**2 + 0.02 * theta**4)
    assert lens.pixels(np.array(0.3), np.array(-0.4))[:2] == pytest.approx(
        (50 * far * 0.6 + 25.3, 48 * far * -0.8 + 18.6), abs=1e-12
    )
    assert lens.pixels(np.zeros(1), np.zeros(1))[0] == 25.3


@settings(max_examples=25)
@given(st.floats(-0.2, 0.4), st.floats(-0.1, 0.1), st.floats(-0.01, 0.01), st.floats(-0.01, 0.01), st.booleans())
def test_a_picture_comes_out_straight(k1, k2, p1, p2, fisheye):
    """Of a smooth pattern of rays: what the lens took, straightened, is what a pinhole camera takes."""
    lens = replace(LENS, radial=(k1, k2), tangential=(0.0, 0.0) if fisheye else (p1, p2), fisheye=fisheye)

    def pattern(x, y):
        return np.stack([128 + 100 * np.sin(3 * x), 128 + 100 * np.cos(3 * y), 128 + 80 * np.sin(2 * x + 2 * y)], -1)

    v, u = np.meshgrid(np.arange(40) + 0.5, np.arange(48) + 0.5, indexing="ij")
    taken = np.dstack([np.rint(pattern(*inverse(lens, u, v))).astype(np.uint8), np.full((40, 48), 255, np.uint8)])
    got = straighten(taken, lens)[..., :3].astype(float)
    x, y = (u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy
    at = lens.pixels(x, y)
    within = (at[0] > 1) & (at[0] < 47) & (at[1] > 1) & (at[1] < 39)
    assert within.mean() > 0.5
    np.testing.assert_allclose(got[within], pattern(x, y)[within], atol=2.0)


def test_straight_ones_stay_as_they_are():
    picture = np.random.default_rng(0).integers(0, 256, (40, 48, 4), np.uint8)
    assert straighten(picture, LENS) is picture
    assert replace(LENS, radial=(0.0, 0.0)).straight and not replace(LENS, fisheye=True).straight


def test_where_the_model_turns_back_nothing_is_seen():
    lens = replace(LENS, radial=(-1.0,))  # r (1 - r²) rises up to r = 0.577
    out = straighten(np.full((40, 48, 4), 255, np.uint8), lens)
    v, u = np.meshgrid(np.arange(40) + 0.5, np.arange(48) + 0.5, indexing="ij")
    far = np.hypot((u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy) > 1 / math.sqrt(3)
    assert far.any() and (out[far] == 0).all() and (out[~far] == 255).all()


def test_sampled_between_pixels_and_weighted_by_alpha():
    image = np.array([[[200, 0, 0, 255], [0, 0, 0, 0]]] * 2, np.uint8)

    def at(u, v, picture=image):
        return sample(picture, Taps.at(np.array(u), np.array(v), 2, 2)).tolist()

    assert at([1.0], [0.5]) == [[200, 0, 0, 128]]  # the colour of what is transparent does not count
    assert at([-9.0, 9.0], [9.0, -9.0]) == [[200, 0, 0, 255], [0, 0, 0, 0]]
    opaque = image | np.array([0, 0, 0, 255], np.uint8)
    assert at([1.0, 0.75, 1.5], [0.5, 1.0, 1.5], opaque) == [[100, 0, 0, 255], [150, 0, 0, 255], [0, 0, 0, 255]]


def test_resized():
    lens = LENS.resized(24, 80)
    assert (lens.fx, lens.fy, lens.cx, lens.cy, lens.width, lens.height) == (25, 96, 12.65, 37.2, 24, 80)
