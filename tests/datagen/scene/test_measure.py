# SPDX-License-Identifier: GPL-3.0-or-later
import bpy
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from timesplat.datagen.scene.measure import holds_still, motion, normalisation, vertices_at
from timesplat.datagen.scene.open import empty_session, open_asset
from timesplat.datagen.sequence import InputError, Normalisation

from ..helpers import cube, key


def test_normalisation_is_over_all_frames(two_clips):
    asset = open_asset(two_clips)
    asset.play(next(c for c in asset.clips if c.name == "slide"))
    norm, box = normalisation([0, 5, 10])  # x: -1..6, y: -1..10, z: -1..1
    # the farthest from their middle: A's corner at its start, B's at its end
    assert norm.scale == pytest.approx(np.sqrt(3.5**2 + 5.5**2 + 1) / 1.1) and norm.translation == pytest.approx(
        (2.5, 4.5, 0)
    )
    assert np.allclose(box * norm.scale + norm.translation, [[-1, -1, -1], [6, 10, 1]], atol=1e-5)
    only, _ = normalisation([0], [bpy.data.objects["A"]])
    assert only == Normalisation(CUBE, (0.0, 0.0, 0.0))


CUBE = float(np.sqrt(3) / 1.1)  # the scale of one of half-side 1


@settings(max_examples=20)
@given(st.tuples(*[st.floats(0.05, 3)] * 3), st.tuples(*[st.floats(-5, 5)] * 3))
def test_every_vertex_is_in_the_box_and_in_the_ball(half, centre):
    empty_session()
    ob = cube(location=centre)
    ob.scale = half
    norm, box = normalisation([1])
    radius, side = np.linalg.norm(half), max(half)
    assert norm.scale == pytest.approx(max(side, radius / 1.1), rel=1e-4)
    assert np.allclose(norm.translation, centre, atol=1e-4) and np.abs(box).max() <= 1 + 1e-6


def test_a_ball_fills_the_box():
    empty_session()
    bpy.ops.mesh.primitive_uv_sphere_add(segments=64, ring_count=32)
    assert normalisation([1])[0].scale == pytest.approx(1, abs=1e-6)


def test_instances_count_and_hidden_things_do_not():
    empty_session()
    inner = bpy.data.collections.new("inner")
    inner.objects.link(bpy.data.objects.new("part", cube().data))
    bpy.data.objects.remove(bpy.context.object)
    for i in range(2):
        empty = bpy.data.objects.new(f"e{i}", None)
        empty.instance_type, empty.instance_collection, empty.location = "COLLECTION", inner, (10 * i, 0, 0)
        bpy.context.collection.objects.link(empty)
    cube("hidden", (0, 50, 0)).hide_render = True
    off = bpy.data.collections.new("off")
    bpy.context.scene.collection.children.link(off)
    off.objects.link(bpy.data.objects.new("in hidden", inner.objects[0].data))
    off.objects[0].location, off.hide_render = (0, 0, 99), True
    norm, _ = normalisation([1])
    assert norm == Normalisation(6.0, (5.0, 0.0, 0.0))


def test_everything_at_one_point_or_nothing_to_see():
    empty_session()
    with pytest.raises(InputError, match=r"^x: no mesh is visible.*\.$"):
        normalisation([1], name="x")
    cube().scale = (0, 0, 0)
    with pytest.raises(InputError, match=r"^x: all vertices lie at one point.*\.$"):
        normalisation([1], name="x")


def test_what_is_asked_twice_is_measured_once_and_what_holds_still_moves_by_0():
    empty_session()
    key(cube(), "location", {1: (0, 0, 0), 3: (2, 0, 0)})
    shown = list(vertices_at([1, 3, 3]))
    assert [[name for name, _ in parts] for parts in shown] == [["Cube"], ["Cube"]]
    assert np.allclose(shown[1][0][1] - shown[0][0][1], (2, 0, 0))
    assert motion([3, 3]) == 0 and motion([1, 3]) == pytest.approx(2 / 2)  # the box is 4 long


def test_what_only_the_viewport_hides_is_measured_in_both_ways():
    empty_session()
    ob = cube()
    ob.hide_viewport = True
    for rendered in (True, False):
        assert normalisation([1], [ob], rendered=rendered)[0] == Normalisation(CUBE, (0.0, 0.0, 0.0))
    assert ob.hide_viewport


def mesh(name, vertices, edges=(), faces=()):
    data = bpy.data.meshes.new(name)
    data.from_pydata(vertices, edges, faces)
    ob = bpy.data.objects.new(name, data)
    bpy.context.collection.objects.link(ob)
    return ob


@pytest.mark.parametrize("loose", ["edges", "points", "beside faces"])
def test_what_no_render_shows_does_not_count(loose):
    empty_session()
    far = [(50, 0, 0), (0, 0, 90)]
    if loose == "beside faces":
        mesh("both", [(-1, 0, -1), (1, 0, -1), (0, 0, 1), *far], [(3, 4)], [(0, 1, 2)])
    else:
        mesh("faces", [(-1, 0, -1), (1, 0, -1), (0, 0, 1)], faces=[(0, 1, 2)])
        mesh("loose", far, [(0, 1)] if loose == "edges" else [])
    norm, box = normalisation([1])
    assert norm.translation == (0, 0, 0) and norm.scale == pytest.approx(np.sqrt(2) / 1.1)
    assert np.allclose(box * norm.scale, [[-1, 0, -1], [1, 0, 1]])
    assert motion([1, 2]) == 0


@pytest.mark.parametrize("edges", [[(0, 1), (1, 2)], []])
def test_points_and_wires_alone_are_refused(edges):
    empty_session()
    mesh("loose", [(0, 0, 0), (1, 0, 0), (0, 1, 0)], edges)
    with pytest.raises(InputError, match=r"^x: .* points and edges alone; .*\.$"):
        normalisation([1], name="x")


def test_edges_that_a_modifier_gives_faces_are_measured():
    empty_session()
    wire = mesh("wire", [(0, 0, 0), (0, 0, 2)], [(0, 1)])
    wire.modifiers.new("skin", "SKIN")
    assert normalisation([1])[0].scale > 0.9


@pytest.mark.parametrize("size", [1e-9, 1e-3, 1e7])
def test_what_holds_still(size):
    empty_session()
    ob = cube(size=2)
    ob.scale = (size,) * 3
    assert holds_still([1, 2, 3])
    key(ob, "location", {1: (0, 0, 0), 3: (0.01 * size, 0, 0)})
    assert not holds_still([1, 2, 3]) and holds_still([3, 3, 4])
    ob.animation_data_clear()
    other = cube("other")
    key(other, "hide_render", {1: False, 3: True})
    assert not holds_still([1, 2, 3])
