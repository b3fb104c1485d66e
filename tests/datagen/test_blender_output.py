# SPDX-License-Identifier: GPL-3.0-or-later
import numpy as np

from timesplat.datagen.blender_output import to_passes, to_straight_srgb


def test_depth_is_normalised_and_vectors_are_turned():
    z = np.array([[4.0, 1e10]], np.float32)
    vector = np.array([[[1, 2, 3, 4], [0, 0, 0, 0]]], np.float32)  # back: right 1, up 2; ahead (reversed): 3, 4
    passes = to_passes({"z": z, "vector": vector}, 2.0)
    assert passes.depth.tolist() == [[2.0, np.inf]]
    assert passes.flow_prev[0, 0].tolist() == [1, -2] and passes.flow_next[0, 0].tolist() == [-3, 4]


def test_colour_is_divided_by_alpha_then_encoded():
    linear = np.array([[0.5, 0.107, 0.0, 0.5], [0.3, 0.3, 0.3, 0.0], [9.0, 0.0, 0.001, 1.0]])
    assert to_straight_srgb(linear).tolist() == [[255, 127, 0, 128], [0, 0, 0, 0], [255, 0, 3, 255]]
