# SPDX-License-Identifier: GPL-3.0-or-later
"""Surface tracks, against Blender's evaluated meshes read by hand, through the kinds of animation and the importers."""

import math

import bpy
import numpy as np
import pytest
from mathutils import Vector
from mathutils.bvhtree import BVHTree

from timesplat.datagen import rigs
from timesplat.datagen.capture import Subject, capture
from timesplat.datagen.render_setup import CaptureSettings
from timesplat.datagen.scene.open import empty_session, open_asset
from timesplat.datagen.scene.simulate import simulate
from timesplat.datagen.sequence import InputError, Normalisation
from timesplat.datagen.tracks import track_surfaces

from .helpers import cube, key

NORM = Normalisation(1.7, (0.2, -0.1, 0.3))
FRAMES = [1, 2.25, 3, 4.5]
PIXEL = 0.02


@pytest.fixture(autouse=True)
def nothing():
    empty_session()


def track(frames=FRAMES, count=300, **options):
    return track_surfaces(frames, NORM, PIXEL, count, **options)


def read_by_hand(frame, names=None):
    """World vertices (V,3) and triangles (T,3) of all meshes that the scene shows, joined."""
    whole = math.floor(frame)
    bpy.context.scene.frame_set(whole, subframe=frame - whole)
    vertices, triangles, count = [], [], 0
    for instance in bpy.context.evaluated_depsgraph_get().object_instances:
        ob = instance.object
        if ob.type != "MESH" or not instance.show_self or (names and ob.name not in names):
            continue
        matrix = instance.matrix_world.copy()
        vertices += [matrix @ v.co for v in ob.data.vertices]
        triangles += [[count + i for i in t.vertices] for t in ob.data.loop_triangles]
        count = len(vertices)
    return np.array(vertices), np.array(triangles)


def weights_in(triangle, point):
    """(3,) barycentric coordinates of a point in a triangle (3,3)."""
    return np.linalg.lstsq(np.vstack([triangle.T, np.ones(3)]), np.append(point, 1), rcond=None)[0]


def matrices(q):
    w, x, y, z = np.moveaxis(np.asarray(q, float), -1, 0)
    rows = [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)]]
    rows += [[2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]]
    rows += [[2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def assert_rides(tracks, frames, names=None, at_least=300):
    """Each point stays at one place of one triangle of the meshes, and z of its frame is this triangle's normal."""
    assert len(tracks) >= at_least
    world = tracks.position.astype(float) * NORM.scale + NORM.translation
    shapes = [read_by_hand(frame, names) for frame in frames]
    triangles = shapes[0][1]
    tree = BVHTree.FromPolygons([Vector(v) for v in shapes[0][0]], triangles.tolist())
    z = matrices(tracks.rotation)[..., 2]
    assert np.allclose(np.linalg.norm(tracks.rotation.astype(float), axis=-1), 1, atol=2e-3)
    assert ((tracks.rotation[:, 1:].astype(float) * tracks.rotation[:, :-1]).sum(-1) >= 0).all()
    facing = []
    for point, normal in zip(world, z, strict=True):
        _, _, index, distance = tree.find_nearest(Vector(point[0]))
        assert distance < 1e-4
        corner = triangles[index]
        w = weights_in(shapes[0][0][corner], point[0])
        moved = np.array([w @ vertices[corner] for vertices, _ in shapes])
        assert np.abs(moved - point).max() < 2e-4
        a, b, c = np.stack([vertices[corner] for vertices, _ in shapes], 1)
        n = np.cross(b - a, c - a)
        n /= np.linalg.norm(n, axis=1, keepdims=True)
        facing.append((n * normal).sum(1))
    assert (np.array(facing) > 0.999).all(1).mean() > 0.97  # but for points on an edge, that found its other triangle


# ---------------------------------------------------------------- what moves


def bent_by_bones():
    bpy.ops.mesh.primitive_cylinder_add(vertices=12, radius=0.3, depth=2)
    ob = bpy.context.object
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.subdivide(number_cuts=3)
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.ops.object.armature_add(location=(0, 0, -1))
    rig = bpy.context.object
    bpy.ops.object.mode_set(mode="EDIT")
    bones = rig.data.edit_bones
    bones[0].tail = (0, 0, 1)
    tip = bones.new("tip")
    tip.head, tip.tail, tip.parent = (0, 0, 1), (0, 0, 2), bones[0]
    bpy.ops.object.mode_set(mode="OBJECT")
    for name, part in (("Bone", lambda z: max(0, 0.5 - z)), ("tip", lambda z: max(0, 0.5 + z))):
        group = ob.vertex_groups.new(name=name)
        for v in ob.data.vertices:
            group.add([v.index], part(v.co.z), "REPLACE")
    ob.modifiers.new("skin", "ARMATURE").object = rig
    bone = rig.pose.bones["tip"]
    bone.rotation_mode = "XYZ"
    key(bone, "rotation_euler", {1: (0, 0, 0), 5: (1.2, 0.4, 0)})
    key(rig, "location", {1: (0, 0, -1), 5: (0.5, 0, -1)})
    return ob


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


def geometry_nodes(ob, build):
    """A modifier of nodes that `build(nodes, connect)` adds, from "in" to "out"."""
    group = bpy.data.node_groups.new("nodes", "GeometryNodeTree")
    for way in ("INPUT", "OUTPUT"):
        group.interface.new_socket("Geometry", in_out=way, socket_type="NodeSocketGeometry")
    nodes = {"in": group.nodes.new("NodeGroupInput"), "out": group.nodes.new("NodeGroupOutput")}

    def add(kind):
        return group.nodes.new(kind)

    build(add, group.links.new, nodes["in"].outputs[0], nodes["out"].inputs[0])
    ob.modifiers.new("nodes", "NODES").node_group = group


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


# ---------------------------------------------------------------- what is there, and when


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


def building_up(ob):
    m = ob.modifiers.new("m", "BUILD")
    m.frame_start, m.frame_duration = 1, 10


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
    assert seq.untracked == ["changing"] and len(seq.load_tracks()) == 0
