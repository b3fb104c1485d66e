# SPDX-License-Identifier: GPL-3.0-or-later
"""What is said of others' data on a command line, and what cannot be."""

import argparse

import numpy as np
import pytest

from timesplat.datagen import rigs
from timesplat.datagen.readers.options import AXES, ReadOptions, add_arguments, from_arguments
from timesplat.datagen.sequence import InputError


def parsed(*words):
    p = argparse.ArgumentParser()
    add_arguments(p)
    return from_arguments(p.parse_args(words))


def test_from_a_command_line():
    assert parsed() == ReadOptions()
    told = parsed("--axes", "opencv", "--times", "none", "--background", "#00ff00", "--scale", "3")
    assert told == ReadOptions("#00ff00", "opencv", "none", None, 3)
    assert parsed("--aabb", "-1", "-2", "-3", "1", "2", "3").aabb == (-1, -2, -3, 1, 2, 3)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("--axes unity", "--axes unity: no such convention; choose opengl"),
        ("--background puce", "--background puce: choose white"),
        ("--aabb 1 1 1 0 2 2", "--aabb: give x0 y0 z0 x1 y1 z1"),
        ("--aabb nan 1 1 2 2 2", "--aabb: give"),
        ("--scale 0", "--scale 0: give more than 0"),
    ],
)
def test_refused(words, says):
    with pytest.raises(InputError, match=says):
        parsed(*words.split())


def test_each_convention_is_undone():
    m = rigs.spherical(30, 20)
    cv = m @ np.diag([1, -1, -1, 1])
    flip = np.diag([1, 1, -1, 1])
    written = {"opengl": m, "opencv": cv, "left-handed": flip @ m @ flip, "w2c-opengl": np.linalg.inv(m)}
    written["w2c-opencv"] = np.linalg.inv(cv)
    assert written.keys() == AXES.keys()
    for axes, matrix in written.items():
        np.testing.assert_allclose(AXES[axes](matrix), m, atol=1e-12)
    np.testing.assert_allclose(AXES["left-handed"](m @ flip), m, atol=1e-12)  # mirrored cameras in a world that is not
