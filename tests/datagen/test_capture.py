# SPDX-License-Identifier: GPL-3.0-or-later
import json
from dataclasses import replace

import bpy
import numpy as np
import pytest

from timesplat.datagen import rigs
from timesplat.datagen.capture import Subject, capture
from timesplat.datagen.render_setup import CaptureSettings
from timesplat.datagen.rigs import Shot
from timesplat.datagen.scene.open import empty_session
from timesplat.datagen.sequence import InputError, Normalisation

STEP, TURN = np.array([0.11, 0.0, 0.06]), np.radians(6)  # of the plane, per frame
NORM = Normalisation(1.6, (0.3, 0.1, -0.2))


@pytest.fixture
def plane():
    """A checkered 2x2 plane in the XZ plane, facing the front, that moves and turns about its normal."""
    empty_session()
    bpy.ops.mesh.primitive_plane_add(size=2, rotation=(np.pi / 2, 0, 0))
    ob = bpy.context.object
    ob.data.transform(ob.matrix_world)
    ob.rotation_euler = (0, 0, 0)
    material = bpy.data.materials.new("checker")
    nodes = material.node_tree.nodes
    checker = nodes.new("ShaderNodeTexChecker")
    uv = nodes.new("ShaderNodeTexCoord").outputs["UV"]
    material.node_tree.links.new(uv, checker.inputs["Vector"])
    material.node_tree.links.new(checker.outputs[0], nodes["Principled BSDF"].inputs["Base Color"])
    ob.data.materials.append(material)
    for frame in range(0, 11):
        ob.location = STEP * frame
        ob.rotation_euler = (0, TURN * frame, 0)
        ob.keyframe_insert("location", frame=frame)
        ob.keyframe_insert("rotation_euler", frame=frame)
    return ob


def about_y(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def expected(view, frame, width, height, ahead):
    """Depth, and motion to the frame `frame + ahead`, of the plane through each pixel's centre, by hand."""
    y, x = np.mgrid[:height, :width] + 0.5
    ray = np.stack([(x - view.cx) / view.fx, -(y - view.cy) / view.fy, -np.ones_like(x)], -1)
    c2w = NORM.to_world(view.c2w)
    R, o = c2w[:3, :3], c2w[:3, 3]
    d = ray @ R.T
    z = -o[1] / d[..., 1]  # the plane is y = 0
    p = o + z[..., None] * d
    local = (p - STEP * frame) @ about_y(TURN * frame)
    hit = np.abs(local[..., [0, 2]]).max(-1) < 1
    q = local @ about_y(TURN * (frame + ahead)).T + STEP * (frame + ahead)
    c = (q - o) @ R
    there = np.stack([view.cx - view.fx * c[..., 0] / c[..., 2], view.cy + view.fy * c[..., 1] / c[..., 2]], -1)
    return z / NORM.scale, there - np.stack([x, y], -1), hit


def inside(mask):
    """The pixels whose neighbours up to two steps away are in the mask as well: the pixel filter reaches there."""
    out = mask.copy()
    for axis in (0, 1):
        out = np.all([np.roll(out, step, axis) for step in range(-2, 3)], 0)
    out[:2], out[-2:], out[:, :2], out[:, -2:] = False, False, False, False
    return out


def on_white(rgba):
    alpha = rgba[..., 3:] / 255
    return rgba[..., :3] * alpha + 255 * (1 - alpha)


def test_depth_and_motion_are_those_computed_by_hand(plane, tmp_path):
    frames = [3, 4, 5, 5]  # scene frames; the last one repeats, as in a padded clip
    poses = [rigs.spherical(10, 5, 2.2), rigs.spherical(-35, 25, 2.6), rigs.spherical(40, -20, 2.4)]
    shots = [Shot(i, "moving", "r", poses[i % 3], 55 - 5 * i) for i in range(4)]
    shots += [Shot(i, "still", "r", poses[1], 60) for i in range(4)]
    width, height = 45, 31
    seq = capture(shots, tmp_path / "s", Subject(frames, NORM), CaptureSettings(size=(width, height), samples=16))
    assert (seq.width, seq.height, seq.frame_start, seq.frame_end, len(seq.views)) == (45, 31, 0, 3, 8)
    for i, v in enumerate(seq.views):
        p, rgba = seq.load_passes(i), seq.load_image(i)
        ahead, before = frames[min(v.frame + 1, 3)] - frames[v.frame], frames[v.frame - 1] - frames[v.frame]
        ahead = ahead if v.frame < 3 else 1  # beyond the clip: what the scene does
        before = before if v.frame > 0 else -1
        z, flow_next, hit = expected(v, frames[v.frame], width, height, ahead)
        _, flow_prev, _ = expected(v, frames[v.frame], width, height, before)
        body = inside(hit)
        assert body.sum() > 150
        assert np.abs(p.flow_next - flow_next)[body].max() < 0.05
        assert np.abs(p.flow_prev - flow_prev)[body].max() < 0.05
        assert (np.abs(flow_next[body]).max() > 1) == (ahead != 0)
        # the depth sample lies somewhere in the pixel's filter: within a pixel and a half of its centre
        slope = np.abs(np.gradient(z)).sum(0)
        assert (np.abs(p.depth - z)[body] <= 1.5 * slope[body] + 1e-4).all()
        assert np.abs((p.depth - z)[body].mean()) < 0.1 * slope[body].mean() + 1e-4  # and has no bias
        far = inside(~hit)
        assert np.isinf(p.depth[far]).all() and (rgba[far] == 0).all() and (rgba[body][:, 3] == 255).all()


@pytest.mark.parametrize("frames", [[1, 4, 7], [1, 4.5, 8, 8]])
def test_motion_over_several_scene_frames_is_exact(plane, tmp_path, frames):
    """The plane turns 18 degrees and more from frame to frame of the clip: no multiple of one scene frame's motion."""
    shots = [Shot(i, "still", "r", rigs.spherical(10, 5, 2.6), 60) for i in range(len(frames))]
    seq = capture(shots, tmp_path / "s", Subject(frames, NORM), CaptureSettings(size=40, samples=16))
    for i, at in enumerate(frames[:3]):
        p = seq.load_passes(i)
        ahead = min(frames[i + 1] if i + 1 < len(frames) else at + 3, 10) - at  # it moves from 0 to 10
        before = max(frames[i - 1] if i else 2 * at - frames[1], 0) - at
        _, flow_next, hit = expected(seq.views[i], at, 40, 40, ahead)
        _, flow_prev, _ = expected(seq.views[i], at, 40, 40, before)
        body = inside(hit)
        assert body.sum() > 100
        assert np.abs(p.flow_next - flow_next)[body].max() < 0.05
        assert np.abs(p.flow_prev - flow_prev)[body].max() < 0.05
        _, one, _ = expected(seq.views[i], at, 40, 40, 1)
        assert i or np.abs(ahead * one - flow_next)[body].max() > 0.2  # what multiplying would be off


@pytest.mark.parametrize(("frames", "fps"), [([3, 6], 8), ([3, 3], 24), ([3], 24)])
def test_seconds_are_those_of_the_scene(plane, tmp_path, frames, fps):
    shots = [Shot(i, "c", "r", rigs.spherical(10, 5, 2.2)) for i in range(len(frames))]
    capture(shots, tmp_path / "s", Subject(frames, NORM), CaptureSettings(size=8, samples=1, passes=False))
    told = json.loads((tmp_path / "s" / "transforms.json").read_text())
    assert told["fps"] == fps and [f["seconds"] for f in told["frames"]] == [i / fps for i in range(len(frames))]


def test_silhouette_depth_is_never_a_mixture(plane, tmp_path):
    shots = [Shot(0, "a", "r", rigs.spherical(20, 10, 2.6))]
    seq = capture(shots, tmp_path / "s", Subject([2], NORM), CaptureSettings(size=40, samples=16))
    depth, alpha = seq.load_passes(0).depth, seq.load_image(0)[..., 3]
    edge = (alpha > 0) & (alpha < 255)
    z = expected(seq.views[0], 2, 40, 40, 1)[0]
    assert edge.sum() > 30
    assert (np.isinf(depth[edge]) | (np.abs(depth - z)[edge] < 0.1)).all()


def test_all_cameras_of_a_frame_at_once_are_each_alone(plane, tmp_path):
    shots = rigs.default_rig([0])
    options = Subject([4], NORM), CaptureSettings(size=32, samples=64)
    together = capture(shots, tmp_path / "all", *options)
    first = capture(shots[:1], tmp_path / "one", *options)
    assert np.array_equal(together.load_image(0), first.load_image(0))  # view 0: to the bit
    for i in (3, 5):
        alone = capture(shots[i : i + 1], tmp_path / f"{i}", *options)
        a, b = on_white(together.load_image(i)), on_white(alone.load_image(0))
        assert np.abs(a - b).mean() < 1  # the other views have noise of their own: 0.5, it falls with samples
        p, q = together.load_passes(i), alone.load_passes(0)
        body = inside(np.isfinite(p.depth) & np.isfinite(q.depth))
        assert np.abs(p.flow_next - q.flow_next)[body].max(initial=0) < 0.05


def test_the_same_seed_gives_the_same_pictures(plane, tmp_path):
    shots, subject = rigs.alternating([0, 1]), Subject([4, 5], NORM)
    settings = [CaptureSettings(size=24, samples=2, passes=False, seed=seed) for seed in (0, 0, 1)]
    a, b, c = (capture(shots, tmp_path / str(i), subject, x) for i, x in enumerate(settings))
    assert all(np.array_equal(a.load_image(i), b.load_image(i)) for i in (0, 1))
    assert not np.array_equal(a.load_image(0), c.load_image(0))


def test_colour_is_srgb_and_straight(tmp_path):
    empty_session()
    bpy.ops.mesh.primitive_plane_add(size=1.3, rotation=(np.pi / 2, 0, 0.2))
    material = bpy.data.materials.new("glow")
    tree = material.node_tree
    tree.nodes.clear()
    glow, end = tree.nodes.new("ShaderNodeEmission"), tree.nodes.new("ShaderNodeOutputMaterial")
    glow.inputs[0].default_value = (1.0, 0.2, 0.01, 1)
    tree.links.new(glow.outputs[0], end.inputs[0])
    bpy.context.object.data.materials.append(material)
    bpy.context.scene.view_settings.exposure = 2  # an artist's display settings must not matter
    settings = CaptureSettings(size=32, linear=True)
    seq = capture(rigs.canonical([0])[:1], tmp_path / "s", Subject([1], Normalisation()), settings)
    rgba = seq.load_image(0)
    want = [255, round(255 * (1.055 * 0.2 ** (1 / 2.4) - 0.055)), round(255 * (1.055 * 0.01 ** (1 / 2.4) - 0.055))]
    covered = rgba[..., 3] > 0
    assert ((rgba[..., 3] > 0) & (rgba[..., 3] < 255)).any()
    assert np.abs(rgba[covered][:, :3].astype(int) - want).max() <= 1  # at the edge as well
    import OpenEXR

    with OpenEXR.File(str(seq.root / seq.views[0].passes), separate_channels=True) as f:
        green, alpha = (f.channels()[c].pixels.astype(float) for c in "GA")
    assert np.allclose(green, 0.2 * alpha, atol=1e-3)  # premultiplied, scene-linear


# ---------------------------------------------------------------- the artist's scene


def state():
    """All that an artist could notice, as plain data."""
    s, found = bpy.context.scene, {}
    groups = {
        "scene": s,
        "render": s.render,
        "image": s.render.image_settings,
        "cycles": s.cycles,
        "view": s.view_settings,
        "layer": bpy.context.view_layer,
    }
    for i, v in enumerate(s.render.views):
        groups[f"view {i}"] = v
    for name, data in groups.items():
        for p in data.bl_rna.properties:
            if p.type not in ("POINTER", "COLLECTION") and p.identifier != "use_nodes":  # deprecated: warns
                found[name, p.identifier] = str(getattr(data, p.identifier))
    for name in ("scenes", "objects", "cameras", "lights", "worlds", "meshes", "actions", "collections", "images"):
        found[name] = [x.name for x in getattr(bpy.data, name)]
    found["images"] = [x for x in found["images"] if x != "Render Result"]  # every render in Blender makes it
    for ob in bpy.data.objects:
        found[ob.name] = (str(ob.matrix_world), str(ob.location), ob.hide_render, ob.select_get(), ob.users)
    found["links"] = (s.camera, s.world, bpy.context.view_layer.objects.active, [o.name for o in s.objects])
    return found


@pytest.mark.parametrize("lighting", [True, False])
@pytest.mark.parametrize("fail", [False, True])
def test_the_scene_comes_back_exactly(plane, tmp_path, lighting, fail):
    bpy.ops.mesh.primitive_cube_add(location=(3, 0, 0))
    cube = bpy.context.object
    bpy.ops.object.light_add(type="SUN")
    bpy.ops.object.camera_add()
    s = bpy.context.scene
    s.camera = bpy.context.object
    s.world = bpy.data.worlds.new("mine")
    s.render.engine, s.render.resolution_x, s.render.filepath = "BLENDER_WORKBENCH", 123, "/tmp/mine"
    s.frame_set(7, subframe=0.25)
    cube.select_set(True)
    before = state()

    class StopError(Exception):
        pass

    def progress(done, total):
        if fail:
            raise StopError

    def go():
        return capture(
            rigs.alternating([0, 1]),
            tmp_path / "s",
            Subject([4, 5], NORM, objects=[plane] if lighting else None),
            CaptureSettings(size=24, samples=1, lighting=lighting),
            progress=progress,
        )

    if fail:
        with pytest.raises(StopError):
            go()
        assert list(tmp_path.iterdir()) == []
    else:
        go()
    after = state()
    assert {k: (before[k], after.get(k)) for k in before if before[k] != after.get(k)} == {}
    assert before.keys() == after.keys()


def test_only_the_objects_given_are_seen(plane, tmp_path):
    bpy.ops.mesh.primitive_cube_add(size=40, location=(0, 30, 0))
    wall = bpy.context.object
    settings = CaptureSettings(size=24, samples=1, passes=False)
    shot, everything = rigs.canonical([0])[:1], Subject([0], NORM)
    both = capture(shot, tmp_path / "a", everything, settings).load_image(0)
    alone = capture(shot, tmp_path / "b", Subject([0], NORM, objects=[plane]), settings).load_image(0)
    wall.hide_render = True
    hidden = capture(shot, tmp_path / "c", everything, settings).load_image(0)
    assert (both[..., 3] == 255).all() and (alone[..., 3] == 0).any()
    assert np.array_equal(hidden, alone)


def test_the_scene_s_own_lights(plane, tmp_path):
    even = CaptureSettings(size=24, samples=1, passes=False)
    own = replace(even, lighting=False)
    shot, subject = rigs.canonical([0])[:1], Subject([0], NORM)
    dark = capture(shot, tmp_path / "a", subject, own).load_image(0)
    bpy.ops.object.light_add(type="SUN", rotation=(np.pi / 2, 0, 0))
    lit = capture(shot, tmp_path / "b", subject, own).load_image(0)
    assert dark[..., :3].max() < 10 and lit[..., :3].max() > 100
    a = capture(shot, tmp_path / "c", subject, even).load_image(0)
    bpy.context.object.data.energy = 1000
    assert np.array_equal(a, capture(shot, tmp_path / "d", subject, even).load_image(0))


def test_nothing_to_render_is_said(plane, tmp_path):
    with pytest.raises(InputError, match=r"no camera.*;.*\.$"):
        capture([], tmp_path / "s", Subject([1], NORM))


def test_cameras_whose_names_differ_in_signs_alone_get_files_of_their_own(plane, tmp_path):
    pose = rigs.spherical(10, 5, 2.2)
    shots = [Shot(1, "a/b", "r", pose), Shot(0, "a:b", "r", pose)]  # named in the order given, written by frame
    seq = capture(shots, tmp_path / "s", Subject([1, 2], NORM), CaptureSettings(size=8, samples=1))
    assert [v.image for v in seq.views] == ["images/r_a-b-2_0000.png", "images/r_a-b_0001.png"]
    assert [v.passes for v in seq.views] == ["passes/r_a-b-2_0000.exr", "passes/r_a-b_0001.exr"]


def glass(alpha, colour=(0.2, 0.5, 0.9, 1)):
    material = bpy.data.materials.new("glass")
    shader = material.node_tree.nodes["Principled BSDF"]
    shader.inputs["Base Color"].default_value, shader.inputs["Alpha"].default_value = colour, alpha
    return material


@pytest.mark.parametrize("alpha", [0.1, 0.4, 0.9])
def test_faint_surfaces_have_depth_and_motion(plane, tmp_path, alpha):
    """Nothing behind them: theirs is the depth, whatever their alpha."""
    plane.data.materials[0] = glass(alpha)
    shots = [Shot(0, "a", "r", rigs.spherical(20, 10, 2.4))]
    seq = capture(shots, tmp_path / "s", Subject([4], NORM), CaptureSettings(size=32, samples=4, tracks=None))
    p, v = seq.load_passes(0), seq.views[0]
    z, flow_next, hit = expected(v, 4, 32, 32, 1)
    body = inside(hit)
    assert body.sum() > 100 and np.abs(seq.load_image(0)[body][:, 3] / 255 - alpha).max() < 0.2
    assert (np.abs(p.depth - z)[body] <= 1.5 * np.abs(np.gradient(z)).sum(0)[body] + 1e-4).all()
    assert np.abs(p.flow_next - flow_next)[body].max() < 0.05


def test_behind_a_faint_surface_is_what_it_shows(plane, tmp_path):
    """And a surface that is not there at all, as between leaves, has no depth."""
    plane.data.materials[0] = glass(0.1)
    bpy.ops.mesh.primitive_plane_add(size=20, rotation=(np.pi / 2, 0, 0), location=(0, 3, 0))
    wall = bpy.context.object
    shots = [Shot(0, "a", "r", rigs.spherical(0, 0, 2.4))]
    settings = CaptureSettings(size=24, samples=4, tracks=None)
    depth = capture(shots, tmp_path / "s", Subject([0], NORM), settings).load_passes(0).depth
    assert np.mean(np.isclose(depth, 2.4 + (3 - 0.1) / 1.6, atol=1e-3)) > 0.9  # Cycles draws lots for the others
    plane.data.materials[0] = glass(0.3)
    depth = capture(shots, tmp_path / "f", Subject([0], NORM), settings).load_passes(0).depth
    assert np.allclose(depth[8:16, 8:16], 2.4 - 0.1 / 1.6, atol=1e-3)  # the plane's own
    wall.hide_render = True
    plane.data.materials[0] = glass(0.01)
    depth = capture(shots, tmp_path / "t", Subject([0], NORM), settings).load_passes(0).depth
    assert np.isfinite(depth).mean() < 0.1


def test_pictures_that_show_nothing_can_be_a_failure(plane, tmp_path):
    plane.data.materials[0] = glass(0.0)
    shots, settings = rigs.canonical([0]), CaptureSettings(size=16, samples=1, tracks=None)
    with pytest.raises(InputError, match=r"^a.glb: no picture shows anything.*;.*\.$"):
        capture(shots, tmp_path / "s", Subject([0], NORM), settings, refuse_empty="a.glb")
    assert not list(tmp_path.iterdir())
    assert not capture(shots, tmp_path / "s", Subject([0], NORM), settings).load_image(0).any()


def test_a_scene_that_was_enlarged_leads_back_to_the_asset(plane, tmp_path):
    shots, settings = rigs.canonical([0])[:1], CaptureSettings(size=16, samples=1)
    a = capture(shots, tmp_path / "a", Subject([0], NORM), settings)
    b = capture(shots, tmp_path / "b", Subject([0], NORM, unit=4.0), settings)
    assert np.array_equal(a.load_image(0), b.load_image(0)) and a.normalisation == NORM
    assert b.normalisation.scale == 0.4 and np.allclose(b.normalisation.translation, np.array(NORM.translation) / 4)


def test_between_two_frames_of_the_scene(plane, tmp_path):
    """A clip spread over an animation: pictures, depth and motion at fractions of frames."""
    frames = [2, 3.5, 5]
    shots = [Shot(i, "c", "r", rigs.spherical(-20, 15, 2.4)) for i in range(3)]
    seq = capture(shots, tmp_path / "s", Subject(frames, NORM), CaptureSettings(size=32, samples=4))
    assert seq.fps == 24 / 1.5
    for i, frame in enumerate(frames):
        p, (z, flow_next, hit) = seq.load_passes(i), expected(seq.views[i], frame, 32, 32, 1.5)
        body = inside(hit)
        assert (
            body.sum() > 100 and (np.abs(p.depth - z)[body] <= 1.5 * np.abs(np.gradient(z)).sum(0)[body] + 1e-4).all()
        )
        if i < 2:  # Blender's are those of one frame of the scene, taken as going straight on
            assert np.abs(p.flow_next - flow_next)[body].max() < 0.15
    tracks = seq.load_tracks()
    at = np.array(NORM.translation) + NORM.scale * tracks.position
    assert np.allclose(at[:, 1].mean(0) - at[:, 0].mean(0), 1.5 * STEP, atol=0.1)
