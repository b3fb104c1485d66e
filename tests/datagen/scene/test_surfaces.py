# SPDX-License-Identifier: GPL-3.0-or-later
"""What is followed, when it is there, and what is named because it cannot be."""

import bpy
import numpy as np
import pytest

from timesplat.datagen.scene.open import empty_session

from ..helpers import cube, key
from ..track_helpers import NORM, building_up, geometry_nodes, read_by_hand, track


@pytest.fixture(autouse=True)
def nothing():
    empty_session()


def test_renders_decide_what_is_shown():
    """A modifier for renders alone counts, one for the viewport alone does not, and what is hidden has no points."""
    ob = cube(size=1)
    for name, render in (("render", True), ("viewport", False)):
        m = ob.modifiers.new(name, "DISPLACE")
        m.mid_level, m.strength = 0, 0.5 if render else 5
        m.show_render, m.show_viewport = render, not render
    hidden = cube("hidden", (0, 0, 3))
    hidden.hide_render = True
    tracks, _ = track([1], 100)
    radius = np.linalg.norm(tracks.position[:, 0] * 1.7 + NORM.translation, axis=1)
    corner = np.linalg.norm([0.5] * 3) + 0.5
    assert corner / np.sqrt(3) - 1e-3 < radius.min() and radius.max() < corner


def test_a_window():
    key(cube("here", size=0.5), "location", {1: (0, 0, 0), 6: (1, 0, 0)})
    late = cube("late", (0, 3, 0), 0.5)
    for frame, hide in ((1, True), (3, False), (4, True), (5, False)):
        late.hide_render = hide
        late.keyframe_insert("hide_render", frame=frame)
    key(late, "location", {1: (0, 3, 0), 6: (0, 4, 0)})
    tracks, untracked = track([1, 2, 3, 4, 5, 6, 6], 400)
    assert untracked == []
    windows = {tuple(w) for w in zip(tracks.first.tolist(), tracks.last.tolist(), strict=True)}
    assert windows == {(0, 6), (2, 2), (4, 6)}
    blink = tracks.first == 2
    assert (tracks.position[blink] == tracks.position[blink][:, :1]).all() and blink.sum() > 50
    after = tracks.first == 4
    assert (tracks.position[after][:, :4] == tracks.position[after][:, 4:5]).all()
    assert (tracks.position[after][:, 5] == tracks.position[after][:, 6]).all()  # a padded frame
    moved = []
    for frame in (5, 6):
        bpy.context.scene.frame_set(frame)
        moved.append(np.array(late.location) / 1.7)
    step = tracks.position[after][:, 5] - tracks.position[after][:, 4]
    assert moved[0][1] < moved[1][1] and np.allclose(step, moved[1] - moved[0], atol=1e-5)


def test_an_object_of_no_size_for_a_while_keeps_its_frame():
    ob = cube(size=1)
    key(ob, "scale", {1: (0, 0, 0), 2: (0, 0, 0), 3: (1, 1, 1), 4: (0, 0, 0)})
    tracks, _ = track([1, 2, 3, 4], 60)
    q = tracks.rotation.astype(float)
    assert np.abs(q - q[:, 2:3]).max() == 0
    at = tracks.position * 1.7 + np.array(NORM.translation)
    assert np.abs(at[:, [0, 1, 3]]).max() < 1e-6 and np.abs(at[:, 2]).max() > 0.49


def test_what_has_no_faces_is_neither_followed_nor_named():
    cube("solid", size=1)
    wire = bpy.data.meshes.new("wire")
    wire.from_pydata([(0, 0, 0), (3, 0, 0)], [(0, 1)], [])
    empty = (bpy.data.meshes.new("empty"), bpy.data.hair_curves.new("bald"), bpy.data.curves.new("line", "CURVE"))
    for data in (wire, *empty, bpy.data.pointclouds.new("none")):
        bpy.context.collection.objects.link(bpy.data.objects.new(data.name, data))
    bpy.ops.object.light_add(type="SUN")
    tracks, untracked = track([1, 2], 100)
    assert untracked == [] and np.abs(tracks.position * 1.7 + NORM.translation).max() < 0.51


def thinning_out(ob):
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.subdivide(number_cuts=4)
    bpy.ops.object.mode_set(mode="OBJECT")
    key(ob.modifiers.new("m", "DECIMATE"), "ratio", {1: 1.0, 5: 0.3})


def cut_out(ob):
    other = cube("cutter", (0.5, 0.5, 0.5), 0.6)
    other.hide_render = other.hide_viewport = True
    key(other, "location", {1: (0.5, 0.5, 0.5), 5: (0, 0, 0.5)})
    m = ob.modifiers.new("m", "BOOLEAN")
    m.object = other


@pytest.mark.parametrize("change", [building_up, thinning_out, cut_out])
def test_what_changes_its_topology_is_named(change):
    change(cube("changing", size=1))
    cube("steady", (2, 0, 0), 0.5)
    tracks, untracked = track([1, 3, 5], 100)
    assert untracked == ["changing"] and len(tracks) == 100
    assert (tracks.position[:, 0, 0] * 1.7 + 0.2 > 1.7).all()


def test_metaballs_volumes_and_hair_of_particles_are_named():
    bpy.ops.object.metaball_add(radius=0.5)
    ball = bpy.context.object
    bpy.ops.object.metaball_add(radius=0.5)
    key(bpy.context.object, "location", {1: (0, 0, 0), 5: (0.7, 0, 0)})
    bpy.ops.mesh.primitive_plane_add()
    fur = bpy.context.object
    fur.name = "fur"
    fur.modifiers.new("p", "PARTICLE_SYSTEM")
    fur.particle_systems[0].settings.type = "HAIR"
    bpy.ops.mesh.primitive_plane_add()
    smoke = bpy.context.object
    smoke.name = "smoke"

    def build(add, connect, start, end):
        connect(add("GeometryNodeVolumeCube").outputs[0], end)

    geometry_nodes(smoke, build)
    tracks, untracked = track([1, 3, 5], 100)
    assert untracked == sorted([ball.name, "fur", "smoke"])
    assert len(tracks) == 100 and np.ptp(tracks.position[..., 2]) < 1e-6  # the plane that the fur grows on


def test_quads_that_are_cut_otherwise_at_another_frame_are_the_same_quads():
    bpy.ops.mesh.primitive_plane_add(size=2)
    ob = bpy.context.object
    ob.shape_key_add(name="Basis")
    dart = ob.shape_key_add(name="dart")
    dart.data[1].co = (-0.3, 0.3, 0)  # the corner comes in: Blender cuts along the other diagonal
    key(dart, "value", {1: 0.0, 5: 1.0})
    cuts = {tuple(read_by_hand(f)[1].ravel()) for f in (1, 5)}
    tracks, untracked = track([1, 5], 50)
    assert len(cuts) == 2 and untracked == [] and len(tracks) == 50


def test_too_much_to_keep_costs_the_largest_alone(monkeypatch):
    bpy.ops.mesh.primitive_uv_sphere_add(radius=0.5)
    bpy.context.object.name = "large"
    cube("small", (2, 0, 0), 0.5)
    monkeypatch.setattr("timesplat.datagen.scene.surfaces.MOST_FLOATS", 1000)
    tracks, untracked = track([1, 2, 3], 100)
    assert untracked == ["large"] and len(tracks) == 100


def test_what_cannot_be_read_is_named(monkeypatch):
    from timesplat.datagen.scene import surfaces

    def fail(mesh):
        raise RuntimeError

    monkeypatch.setattr(surfaces, "_mesh", fail)
    cube("broken")
    tracks, untracked = track([1, 2], 100)
    assert untracked == ["broken"] and len(tracks) == 0
    assert tracks.position.shape == (0, 2, 3) and tracks.rotation.shape == (0, 2, 4)
