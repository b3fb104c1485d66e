# SPDX-License-Identifier: GPL-3.0-or-later
import numpy as np

from timesplat.datagen.blender_output import fill_faint_surfaces, shows_faint_surfaces, to_passes, to_straight_srgb


def test_depth_is_normalised_and_vectors_are_turned():
    z = np.array([[4.0, 1e10]], np.float32)
    vector = np.array([[[1, 2, 3, 4], [0, 0, 0, 0]]], np.float32)  # back: right 1, up 2; ahead (reversed): 3, 4
    passes = to_passes({"z": z, "vector": vector}, 2.0)
    assert passes.depth.tolist() == [[2.0, np.inf]]
    assert passes.flow_prev[0, 0].tolist() == [1, -2] and passes.flow_next[0, 0].tolist() == [-3, 4]


def test_colour_is_divided_by_alpha_then_encoded():
    linear = np.array([[0.5, 0.107, 0.0, 0.5], [0.3, 0.3, 0.3, 0.0], [9.0, 0.0, 0.001, 1.0]])
    assert to_straight_srgb(linear).tolist() == [[255, 127, 0, 128], [0, 0, 0, 0], [255, 0, 3, 255]]


def channels(depth, alpha=0.3, motion=0.0):
    z = np.array(depth, np.float32)
    shown = np.where(np.isfinite(z) | (z > 0), alpha, 0)[..., None]
    vector = np.full((*z.shape, 4), motion, np.float32)
    return {"z": np.where(np.isfinite(z), z, 1e10), "combined": np.repeat(shown, 4, -1), "vector": vector}


def test_a_silhouette_is_no_faint_surface_and_an_area_is():
    c = channels(np.full((8, 8), np.inf))
    c["combined"][..., 3] = 0
    c["combined"][:, 2:4, 3] = 0.5  # two columns of an edge
    assert not shows_faint_surfaces(c)
    c["combined"][:, 2:5, 3] = 0.5
    assert shows_faint_surfaces(c)
    c["z"][:, 3] = 2.0
    assert not shows_faint_surfaces(c)


def test_faint_surfaces_fill_what_has_no_depth_and_their_own():
    c, faint = channels([[np.inf, 2.0, 5.0, np.inf]]), channels([[2.0, 2.0, 2.0, np.inf]], motion=1.0)
    fill_faint_surfaces(c, faint)
    assert c["z"].tolist() == [[2.0, 2.0, 5.0, np.float32(1e10)]]
    assert c["vector"][0, :, 0].tolist() == [1, 1, 0, 0]
