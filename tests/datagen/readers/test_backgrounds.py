# SPDX-License-Identifier: GPL-3.0-or-later
"""Constant backgrounds: measured where they are, and made transparent so that the same picture comes out over them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from timesplat.datagen.readers.backgrounds import Background, colour_of, common_colour, flood, key_out
from timesplat.datagen.sequence import InputError


def disc(colour, behind, noise=0, hole=0.0, size=40):
    """A soft disc, in the middle of which there may be a patch of the background's colour."""
    y, x = np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5, indexing="ij")
    r = np.hypot(x - size / 2, y - size / 2)
    alpha = np.clip(12.5 - r, 0, 1)[..., None]
    rgb = alpha * np.array(colour) + (1 - alpha) * np.array(behind)
    rgb[r < hole] = behind
    rgb = rgb + np.random.default_rng(0).integers(-noise, noise + 1, rgb.shape)
    return np.clip(np.rint(rgb), 0, 255).astype(np.uint8), alpha[..., 0], r


@pytest.mark.parametrize(("behind", "noise"), [((255, 255, 255), 0), ((0, 177, 64), 3), ((0, 0, 0), 2)])
def test_measured_and_taken_away(behind, noise):
    rgb, alpha, r = disc((200, 40, 60), behind, noise, hole=4)
    found = common_colour([rgb, rgb])
    assert found is not None and found.colour == pytest.approx(behind, abs=2) and found.noise <= 2 * noise + 1
    rgba = key_out(np.dstack([rgb, np.full(rgb.shape[:2], 255, np.uint8)]), found)
    a = rgba[..., 3:].astype(float) / 255
    again = rgba[..., :3] * a + np.array(found.colour) * (1 - a)
    assert np.abs(again - rgb).max() <= found.noise + 4
    assert (rgba[..., 3][r > 14] == 0).all() and (rgba[..., 3][r < 11] == 255).all()  # its hole stays: it may be paint
    edge = (alpha > 0.05) & (alpha < 0.95)
    assert (rgba[..., 3][edge] > 0).mean() > 0.9


def test_no_constant_colour():
    rng = np.random.default_rng(1)
    noise = rng.integers(0, 256, (20, 20, 3), np.uint8)
    white = np.full((20, 20, 3), 255, np.uint8)
    assert common_colour([noise, noise]) is None and common_colour([white, white // 2]) is None
    assert common_colour([white] * 9 + [noise]) is not None and common_colour([]) is None


def test_names():
    assert colour_of("white").colour == (255, 255, 255) and str(colour_of("green")) == "#00ff00"
    assert colour_of("#0a10ff").colour == (10, 16, 255) == Background((10, 16, 255), 0).colour
    for text in ("blueish", "#12", "#12345g", ""):
        with pytest.raises(InputError, match=r"--background .*choose white, black, green, #rrggbb or auto"):
            colour_of(text)


@given(arrays(bool, st.tuples(st.integers(1, 9), st.integers(1, 9))), st.randoms(use_true_random=False))
def test_flood_is_what_can_be_walked_to(open_, random):
    seeds = np.array([[random.random() < 0.2 for _ in row] for row in open_])
    expected = open_ & seeds
    while True:
        p = np.pad(expected, 1)
        more = open_ & (expected | p[2:, 1:-1] | p[:-2, 1:-1] | p[1:-1, 2:] | p[1:-1, :-2])
        if (more == expected).all():
            break
        expected = more
    assert (flood(open_, seeds) == expected).all()
