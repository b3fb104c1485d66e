# SPDX-License-Identifier: GPL-3.0-or-later
"""Surface tracks, against Blender's evaluated meshes read by hand, through the kinds of animation and the importers."""

import math

import bpy
import numpy as np
import pytest

from timesplat.datagen import rigs
from timesplat.datagen.capture import Subject, capture
from timesplat.datagen.render_setup import CaptureSettings
from timesplat.datagen.scene.open import empty_session, open_asset
from timesplat.datagen.scene.simulate import simulate
from timesplat.datagen.sequence import InputError
from timesplat.datagen.tracks import track_surfaces

from .helpers import cube, key
from .track_helpers import (
    FRAMES,
    NORM,
    PIXEL,
    assert_rides,
    bent_by_bones,
    building_up,
    geometry_nodes,
    matrices,
    track,
)


@pytest.fixture(autouse=True)
def nothing():
    empty_session()


# ---------------------------------------------------------------- what moves


def shape_keys():
    ob = cube(size=1)
    ob.shape_key_add(name="Basis")
    tall = ob.shape_key_add(name="tall")
    for v in tall.data:
        v.co = (v.co.x * (1 + v.co.z), v.co.y, 2 * v.co.z)
    key(tall, "value", {1: 0.0, 5: 1.0})


def mirrored():
    ob = cube(size=0.8)
    ob.scale = (-1, 0.5, 1.5)
    key(ob, "location", {1: (0, 0, 0), 5: (1, 1, 0.3)})
    key(ob, "rotation_euler", {1: (0, 0, 0), 5: (0.4, 0.7, 3)})


def wave():
    bpy.ops.mesh.primitive_grid_add(x_subdivisions=8, y_subdivisions=8)
    bpy.context.object.modifiers.new("wave", "WAVE").height = 0.2


def spinning_text():
    bpy.ops.object.text_add()
    ob = bpy.context.object
    ob.data.body, ob.data.extrude = "ab", 0.1
    key(ob, "rotation_euler", {1: (0, 0, 0), 5: (0.2, 1, 2)})


def growing_tube():
    bpy.ops.curve.primitive_bezier_circle_add(radius=0.7)
    key(bpy.context.object.data, "bevel_depth", {1: 0.1, 5: 0.3})


def two_of_a_collection():
    inner = bpy.data.collections.new("inner")
    part = bpy.data.objects.new("part", cube(size=0.4).data)
    bpy.data.objects.remove(bpy.context.object)
    inner.objects.link(part)
    key(part, "location", {1: (0.3, 0, 0), 5: (0.9, 0, 0)})
    for i in range(2):
        empty = bpy.data.objects.new(f"e{i}", None)
        empty.instance_type, empty.instance_collection, empty.location = "COLLECTION", inner, (0, i, 0)
        bpy.context.collection.objects.link(empty)
        key(empty, "rotation_euler", {1: (0, 0, 0), 5: (0, 1 + i, 0)})


def scattered():
    """Cubes on the corners of a plane that turns and is bent; the plane itself is not kept."""
    bpy.ops.mesh.primitive_plane_add(size=1.5)
    ob = bpy.context.object
    ob.shape_key_add(name="Basis")
    bent = ob.shape_key_add(name="bent")
    bent.data[0].co.z = 1
    key(bent, "value", {1: 0.0, 5: 1.0})
    key(ob, "rotation_euler", {1: (0, 0, 0), 5: (0, 0, 2)})

    def build(add, connect, start, end):
        scatter, box = add("GeometryNodeInstanceOnPoints"), add("GeometryNodeMeshCube")
        box.inputs["Size"].default_value = (0.2, 0.3, 0.4)
        connect(start, scatter.inputs["Points"])
        connect(box.outputs["Mesh"], scatter.inputs["Instance"])
        connect(scatter.outputs[0], end)

    geometry_nodes(ob, build)


def particles():
    """Cubes that fall."""
    part = cube("part", size=0.2)
    part.hide_render = part.hide_viewport = True
    bpy.ops.mesh.primitive_plane_add(size=1)
    ob = bpy.context.object
    ob.modifiers.new("p", "PARTICLE_SYSTEM")
    ob.show_instancer_for_render = False
    settings = ob.particle_systems[0].settings
    settings.count, settings.frame_start, settings.frame_end = 5, 1, 1
    settings.render_type, settings.instance_object, settings.particle_size = "OBJECT", part, 1


@pytest.mark.parametrize(
    "build",
    [bent_by_bones, shape_keys, mirrored, wave, spinning_text, growing_tube, two_of_a_collection, scattered],
)
def test_points_ride_with_the_evaluated_surface(build):
    build()
    tracks, untracked = track()
    assert untracked == [] and (tracks.first == 0).all() and (tracks.last == 3).all()
    assert_rides(tracks, FRAMES)


def test_cloth():
    bpy.ops.mesh.primitive_grid_add(x_subdivisions=6, y_subdivisions=6)
    bpy.context.object.modifiers.new("cloth", "CLOTH")
    bpy.context.scene.frame_end = 6
    simulate(6)
    tracks, untracked = track([1, 3, 6], 100)
    assert untracked == [] and np.abs(tracks.position[:, 2] - tracks.position[:, 0]).max() > 0.02
    assert_rides(tracks, [1, 3, 6], at_least=100)


def test_particles_that_show_objects():
    particles()
    simulate(6)
    tracks, untracked = track([2, 4, 6], 400)
    assert untracked == []
    assert (tracks.position[:, 0, 2] - tracks.position[:, 2, 2]).min() > 0.01
    step = tracks.position[:, 2] - tracks.position[:, 0]
    assert len(np.unique(step.round(4), axis=0)) <= 5  # those of one cube move as one, for they do not turn


def test_rigid_motion_turns_the_frames_by_itself():
    mirrored()
    tracks, _ = track([1, 2, 3, 4, 5], 50)
    turns = []
    for frame in range(1, 6):
        bpy.context.scene.frame_set(frame)
        turns.append(np.array(bpy.context.object.matrix_world.to_quaternion().to_matrix()))
    own = matrices(tracks.rotation)
    assert np.allclose(np.linalg.det(own), 1, atol=5e-3)
    for f in range(5):
        want = turns[f] @ turns[0].T
        assert np.abs(own[:, f] @ own[:, 0].transpose(0, 2, 1) - want).max() < 5e-3


def test_hair_curves():
    curves = bpy.data.hair_curves.new("hair")
    curves.add_curves([5] * 20)
    rng = np.random.default_rng(0)
    roots = np.repeat(rng.uniform(-1, 1, (20, 3)), 5, 0)
    points = roots + np.tile(np.arange(5), 20)[:, None] * (0.05, 0.02, 0.1)
    curves.attributes["position"].data.foreach_set("vector", points.astype(np.float32).ravel())
    ob = bpy.data.objects.new("hair", curves)
    bpy.context.collection.objects.link(ob)
    key(ob, "rotation_euler", {1: (0, 0, 0), 5: (0, 2, 0)})
    tracks, untracked = track(count=500)
    assert untracked == [] and len(tracks) == 500
    world = tracks.position.astype(float) * NORM.scale + NORM.translation
    x = matrices(tracks.rotation)[..., 0]
    for f, frame in enumerate(FRAMES):
        bpy.context.scene.frame_set(math.floor(frame), subframe=frame % 1)
        turn = np.array(ob.matrix_world)[:3, :3]
        local = world[:, f] @ turn
        along = np.array([0.05, 0.02, 0.1]) / np.linalg.norm([0.05, 0.02, 0.1])
        off = local[:, None] - roots[None, ::5]
        off -= (off @ along)[..., None] * along
        assert np.linalg.norm(off, axis=-1).min(1).max() < 1e-4
        assert np.abs(x[:, f] @ turn - along).max() < 5e-3
    assert len(np.unique(np.linalg.norm(world[:, 0, None] - roots[None, ::5], axis=-1).argmin(1))) == 20


def test_a_point_cloud():
    bpy.ops.mesh.primitive_plane_add(size=1)
    ob = bpy.context.object
    key(ob, "location", {1: (0, 0, 0), 5: (1, 0, 0)})

    def build(add, connect, start, end):
        to_points = add("GeometryNodeMeshToPoints")
        to_points.inputs["Radius"].default_value = 0.1
        connect(start, to_points.inputs[0])
        connect(to_points.outputs[0], end)

    geometry_nodes(ob, build)
    tracks, untracked = track([1, 5], 80)
    assert untracked == [] and len(tracks) == 80
    assert np.allclose(tracks.position[:, 1] - tracks.position[:, 0], (1 / 1.7, 0, 0), atol=1e-5)
    world = tracks.position[:, 0] * 1.7 + NORM.translation
    corner = np.linalg.norm(world[:, None] - [v.co for v in ob.data.vertices], axis=-1)
    assert (corner.min(1) < 0.1001).all() and np.bincount(corner.argmin(1)).min() >= 10


# ---------------------------------------------------------------- where the points lie


def test_what_lies_inside_has_no_points():
    for radius in (1, 0.6):
        bpy.ops.mesh.primitive_ico_sphere_add(radius=radius, subdivisions=4)
    tracks, untracked = track([1, 2], 0)
    radius = np.linalg.norm(tracks.position[:, 0] * 1.7 + NORM.translation, axis=1)
    assert untracked == [] and radius.min() > 0.95
    assert tracks.area.sum() == pytest.approx(4 * np.pi / 1.7**2, rel=0.01)
    assert len(tracks) == pytest.approx(tracks.area.sum() / PIXEL**2, rel=1e-3)


def test_a_lid_that_opens_lets_the_inside_be_seen():
    box = cube("box", size=1)
    box.data.materials.clear()
    bpy.ops.mesh.primitive_ico_sphere_add(radius=0.3, subdivisions=3)
    key(box, "location", {1: (0, 0, 0), 4: (0, 0, 0), 5: (0, 0, 3)})
    tracks, _ = track([1, 2, 3, 4, 5], 1000)
    assert (np.linalg.norm(tracks.position[:, 0] * 1.7 + NORM.translation, axis=1) < 0.31).mean() > 0.1


def test_points_lie_evenly():
    bpy.ops.mesh.primitive_uv_sphere_add(radius=1, segments=64, ring_count=48)
    tracks, _ = track([1], 2000)
    p = tracks.position[:, 0].astype(float) * 1.7
    distance = np.linalg.norm(p[:, None] - p[None], axis=-1)
    np.fill_diagonal(distance, 9)
    spacing = np.sqrt(4 * np.pi / len(p))
    assert distance.min() > 0.5 * spacing  # of points at random: 0.01, and their mean 0.5
    assert distance.min(1).mean() > 0.75 * spacing and (tracks.area == tracks.area[0]).all()


def test_automatic_numbers_have_bounds(monkeypatch):
    monkeypatch.setattr("timesplat.datagen.tracks.MOST", 5000)
    cube(size=0.1)
    assert len(track_surfaces([1], NORM, 0.02)[0]) == 4000 and len(track_surfaces([1], NORM, 1e-5)[0]) == 5000


def test_shift_moves_the_points():
    cube(size=1)
    shift = np.array([[0, 0, 0], [0.1, 0, 0], [0.1, 0.2, 0]])
    still, _ = track([1, 1, 1], 50)
    moved, _ = track([1, 1, 1], 50, shift=shift)
    assert np.allclose(moved.position - still.position, shift, atol=1e-6)


def test_only_the_objects_given():
    a = cube("a", size=1)
    cube("b", (5, 0, 0), 1)
    tracks, _ = track([1], 50, objects=[a])
    assert (tracks.position[..., 0] * 1.7 + 0.2 < 0.6).all()


# ---------------------------------------------------------------- through the importers


@pytest.mark.parametrize("suffix", ["glb", "fbx", "usdc", "obj"])
def test_importers(tmp_path, suffix):
    bent_by_bones()
    bpy.context.scene.frame_end = 5
    path = tmp_path / f"a.{suffix}"
    if suffix == "glb":
        bpy.ops.export_scene.gltf(filepath=str(path))
    elif suffix == "fbx":
        bpy.ops.export_scene.fbx(filepath=str(path))
    elif suffix == "usdc":
        bpy.ops.wm.usd_export(filepath=str(path), export_animation=True)
    else:
        bpy.ops.wm.obj_export(filepath=str(path))
    asset = open_asset(path)
    asset.play(asset.clips[0])
    start, end = asset.clips[0].frame_start, asset.clips[0].frame_end
    frames = [start, start + 0.5, end] if end > start else [start]
    tracks, untracked = track(frames)
    assert untracked == [] and (suffix == "obj") == (end == start)
    if end > start:
        assert np.abs(tracks.position[:, -1] - tracks.position[:, 0]).max() > 0.2
    assert_rides(tracks, frames)


# ---------------------------------------------------------------- beside the pictures


def test_a_capture_writes_them(tmp_path):
    key(cube(size=1), "location", {1: (0, 0, 0), 3: (0.5, 0, 0)})
    shots, subject = rigs.canonical([0, 1]), Subject([1, 3], NORM)
    seq = capture(shots, tmp_path / "a", subject, CaptureSettings(size=8, samples=1, passes=False))
    tracks = seq.load_tracks()
    assert seq.tracks == "tracks.npz" and seq.untracked == [] and len(tracks) == 4000
    assert np.allclose(tracks.position[:, 1] - tracks.position[:, 0], (0.5 / 1.7, 0, 0), atol=1e-5)
    capture(shots, tmp_path / "b", subject, CaptureSettings(size=8, samples=1, passes=False))
    assert (tmp_path / "a" / "tracks.npz").read_bytes() == (tmp_path / "b" / "tracks.npz").read_bytes()
    few = capture(shots, tmp_path / "c", subject, CaptureSettings(size=8, samples=1, tracks=50))
    assert len(few.load_tracks()) == 50
    none = capture(shots, tmp_path / "d", subject, CaptureSettings(size=8, samples=1, tracks=None))
    assert none.tracks is None and not (tmp_path / "d" / "tracks.npz").exists()
    with pytest.raises(InputError, match="no surface tracks"):
        none.load_tracks()


def test_a_capture_names_what_has_none(tmp_path):
    building_up(cube("changing", size=1))
    settings = CaptureSettings(size=8, samples=1, passes=False)
    seq = capture(rigs.canonical([0, 1]), tmp_path / "a", Subject([4, 9], NORM), settings)
    assert seq.untracked == ["changing"] and seq.tracks is None
