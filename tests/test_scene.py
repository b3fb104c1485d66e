# SPDX-License-Identifier: GPL-3.0-or-later
import json
import struct
from pathlib import Path

import bpy
import numpy as np
import pytest

from timesplat.datagen import scene
from timesplat.datagen.sequence import InputError, Normalisation


def cube(name="Cube", location=(0, 0, 0), size=2):
    bpy.ops.mesh.primitive_cube_add(size=size, location=location)
    bpy.context.object.name = name
    return bpy.context.object


def key(owner, path, values):
    """values: frame -> value; linear between."""
    for frame, value in values.items():
        setattr(owner, path, value)
        owner.keyframe_insert(path, frame=frame)


def to_track(owner, name):
    """Puts the current action into an NLA track of that name, as an artist does for a glTF with many clips."""
    action = owner.animation_data.action
    track = owner.animation_data.nla_tracks.new()
    track.name = name
    track.strips.new(name, int(action.frame_range[0]), action)
    owner.animation_data.action = None


def export(path):
    bpy.ops.export_scene.gltf(
        filepath=str(path), export_animation_mode="NLA_TRACKS", export_lights=True, export_cameras=True
    )
    return path


@pytest.fixture(scope="module")
def two_clips(tmp_path_factory):
    """Two cubes with two clips: "slide" moves both over 10 frames, "grow" only one of them and a shape key."""
    scene.empty()
    a, b = cube("A"), cube("B", (0, 4, 0))
    a.shape_key_add(name="Basis")
    tall = a.shape_key_add(name="tall")
    for v in tall.data:
        v.co.z *= 2
    bpy.ops.object.light_add(type="SUN")
    bpy.ops.object.camera_add()
    key(a, "location", {0: (0, 0, 0), 10: (5, 0, 0)})
    to_track(a, "slide")
    key(b, "location", {0: (0, 4, 0), 10: (0, 9, 0)})
    to_track(b, "slide")
    key(b, "scale", {0: (1, 1, 1), 30: (3, 3, 3)})
    to_track(b, "grow")
    key(tall, "value", {0: 0.0, 30: 1.0})
    to_track(a.data.shape_keys, "grow")
    a.location, b.location, b.scale, tall.value = (0, 0, 0), (0, 4, 0), (1, 1, 1), 0
    bpy.context.scene.frame_set(0)  # the exporter takes the rest pose from what this frame shows
    return export(tmp_path_factory.mktemp("clips") / "two.glb")


def boxes(frames):
    """(F,2,3) bounds of all that is visible, at each frame."""
    parts = [np.concatenate([p for _, p in shown]) for shown in scene.measured(frames)]
    return np.round([[p.min(0), p.max(0)] for p in parts], 3)


def test_tracks_named_alike_are_one_clip(two_clips):
    asset = scene.open_asset(two_clips)
    assert {c.name: (c.frame_start, c.frame_end, len(c.actions)) for c in asset.clips} == {
        "slide": (0, 10, 2),
        "grow": (0, 30, 2),
    }
    assert len(asset.sha256) == 64 and not asset.warnings
    assert {o.type for o in bpy.data.objects} == {"MESH"}  # no lights, no cameras


def test_clips_play_whole_and_leave_nothing_behind(two_clips):
    asset = scene.open_asset(two_clips)
    by_name = {c.name: c for c in asset.clips}
    for _ in range(2):  # from either clip to the other
        asset.play(by_name["slide"])
        low, high = boxes([0, 10]).swapaxes(0, 1)
        assert high[0].tolist() == [1, 5, 1] and high[1].tolist() == [6, 10, 1]
        asset.play(by_name["grow"])
        low, high = boxes([0, 30]).swapaxes(0, 1)
        assert low[0].tolist() == [-1, -1, -1] and high[0].tolist() == [1, 5, 1]
        assert high[1].tolist() == [3, 7, 3]
        asset.play(by_name["grow"])


def test_frames_are_padded_by_the_last(two_clips):
    clips = {c.name: c for c in scene.open_asset(two_clips).clips}
    assert clips["slide"].frames(24) == [*range(11), *[10] * 13]
    assert clips["grow"].frames(24) == list(range(24))
    assert scene.Clip("x", 5, 5).frames(24) == [5]


def test_the_most_moving_clip(two_clips):
    asset = scene.open_asset(two_clips)
    assert scene.most_moving(asset).name == "slide"
    assert scene.motion([3, 3]) == 0


def test_normalisation_is_over_all_frames(two_clips):
    asset = scene.open_asset(two_clips)
    asset.play(next(c for c in asset.clips if c.name == "slide"))
    norm, box = scene.normalisation([0, 5, 10])  # x: -1..6, y: -1..10, z: -1..1
    assert norm.scale == pytest.approx(5.5) and norm.translation == pytest.approx((2.5, 4.5, 0))
    assert np.allclose(box * norm.scale + norm.translation, [[-1, -1, -1], [6, 10, 1]], atol=1e-5)
    only, _ = scene.normalisation([0], [bpy.data.objects["A"]])
    assert only == Normalisation(1.0, (0.0, 0.0, 0.0))


def test_instances_count_and_hidden_things_do_not():
    scene.empty()
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
    norm, _ = scene.normalisation([1])
    assert norm == Normalisation(6.0, (5.0, 0.0, 0.0))


def test_a_static_asset_is_one_frame(tmp_path):
    scene.empty()
    cube()
    asset = scene.open_asset(export(tmp_path / "still.glb"))
    assert [(c.name, c.frames(24)) for c in asset.clips] == [("static", [1])]
    asset.play(asset.clips[0])
    assert scene.normalisation([1])[0].scale == pytest.approx(1)


def test_blend_shows_its_scene_then_its_other_actions_and_never_runs_scripts(tmp_path):
    scene.empty()
    ob = cube()
    key(ob, "location", {1: (0, 0, 0), 20: (2, 0, 0)})
    ob.animation_data.action.name = "used"
    key(ob, "rotation_euler", {1: (0, 0, 0)})
    ob.animation_data.action = None
    key(ob, "scale", {5: (1, 1, 1), 9: (2, 2, 2)})
    ob.animation_data.action.name, ob.animation_data.action.use_fake_user = "spare", True
    ob.animation_data.action = bpy.data.actions["used"]
    ob.scale = (1, 1, 1)
    bpy.context.scene.frame_start, bpy.context.scene.frame_end = 1, 20
    text = bpy.data.texts.new("startup.py")
    text.write(f"open({str(tmp_path / 'ran')!r}, 'w')")
    text.use_module = True
    bpy.context.view_layer.objects.active = ob
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    asset = scene.open_asset(tmp_path / "a.blend")
    assert not (tmp_path / "ran").exists()
    assert [(c.name, c.frame_start, c.frame_end) for c in asset.clips] == [("scene", 1, 20), ("spare", 5, 9)]
    asset.play(asset.clips[0])
    assert boxes([20])[0, 1].tolist() == [3, 1, 1]
    asset.play(asset.clips[1])
    assert boxes([9])[0, 1].tolist() == [2, 2, 2]  # grown, and back at its place


@pytest.mark.parametrize("suffix", ["fbx", "obj", "usdc"])
def test_other_formats_open(tmp_path, suffix):
    scene.empty()
    ob, path = cube(), str(tmp_path / f"a.{suffix}")
    if suffix != "obj":
        key(ob, "location", {1: (0, 0, 0), 12: (3, 0, 0)})
        bpy.context.scene.frame_end = 12
    if suffix == "fbx":
        bpy.ops.export_scene.fbx(filepath=path)
    elif suffix == "obj":
        bpy.ops.wm.obj_export(filepath=path)
    else:
        bpy.ops.wm.usd_export(filepath=path, export_animation=True)
    asset = scene.open_asset(Path(path))
    clip = asset.clips[0]
    asset.play(clip)
    assert len(asset.clips) == 1
    assert clip.frame_end - clip.frame_start == (0 if suffix == "obj" else 11)
    assert scene.motion(clip.frames(24)) == 0 if suffix == "obj" else scene.motion(clip.frames(24)) > 0.5


# ---------------------------------------------------------------- what cannot be used


def refused(path, *words):
    with pytest.raises(InputError) as e:
        scene.open_asset(path)
    text = str(e.value)
    assert text.startswith(str(path)) and text.endswith(".") and "\n" not in text and ";" in text
    for word in words:
        assert word in text


def glb(document, binary=b""):
    data = json.dumps(document).encode()
    data += b" " * (-len(data) % 4)
    chunks = struct.pack("<I4s", len(data), b"JSON") + data
    if binary:
        chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def triangle(x=1.0, uri=None, image=None):
    """A glTF document with one triangle whose last x coordinate is given, and its vertices."""
    points = struct.pack("<9f", 0, 0, 0, 0, 1, 0, x, 0, 0)
    uvs = struct.pack("<6f", 0, 0, 0, 1, 1, 0)
    d = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}}]}],
        "buffers": [{"byteLength": 60}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 24}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", "min": [0] * 3, "max": [1] * 3},
            {"bufferView": 1, "componentType": 5126, "count": 3, "type": "VEC2"},
        ],
    }
    if uri:
        d["buffers"][0]["uri"] = uri
    if image:
        d["images"], d["textures"] = [{"uri": image}], [{"source": 0}]
        d["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
        d["meshes"][0]["primitives"][0]["material"] = 0
    return d, points + uvs


def write(path, data):
    path.write_bytes(data if isinstance(data, bytes) else json.dumps(data).encode())
    return path


def test_missing_and_unknown_files(tmp_path):
    refused(tmp_path / "no.glb", "no such file")
    refused(write(tmp_path / "a.stl", b"solid"), "cannot be opened", ".glb")


def test_damaged_files(tmp_path, two_clips):
    whole = two_clips.read_bytes()
    refused(write(tmp_path / "cut.glb", whole[: len(whole) // 2]), "cut off")
    refused(write(tmp_path / "junk.glb", b"junk" * 50), "damaged")
    refused(write(tmp_path / "tiny.glb", b"gl"), "damaged")
    refused(write(tmp_path / "a.gltf", b"{"), "damaged")
    refused(write(tmp_path / "junk.blend", b"junk" * 50), "cannot read")
    refused(write(tmp_path / "junk.fbx", b"junk" * 50), "junk.fbx")
    refused(write(tmp_path / "junk.usdc", b"junk" * 50), "junk.usdc")
    document, binary = triangle()
    document["accessors"][0]["count"] = 10**6
    refused(write(tmp_path / "lies.glb", glb(document, binary)), "lies.glb")


def test_no_mesh(tmp_path):
    document, binary = triangle()
    document["nodes"] = [{"name": "nothing"}]
    refused(write(tmp_path / "a.glb", glb(document, binary)), "no mesh")


@pytest.mark.parametrize("x", [float("nan"), float("inf"), -1e30, 2e6])
def test_mad_vertices(tmp_path, x):
    refused(write(tmp_path / "a.glb", glb(*triangle(x))), "vertices")


def test_references_out_of_the_folder(tmp_path):
    inside = tmp_path / "in"
    inside.mkdir()
    document, binary = triangle(uri="../a.bin")
    write(tmp_path / "a.bin", binary)
    refused(write(inside / "a.gltf", document), "../a.bin", "outside")
    for image in ("../t.png", "/etc/passwd", "%2e%2e/t.png"):
        refused(write(inside / "b.glb", glb(*triangle(image=image))), "outside")
    refused(write(inside / "c.gltf", triangle(uri="no.bin")[0]), "no.bin", "missing")


def test_a_missing_texture_is_said_and_never_magenta(tmp_path):
    document, binary = triangle(image="no.png")
    asset = scene.open_asset(write(tmp_path / "a.glb", glb(document, binary)))
    used = [
        n.image for m in bpy.data.materials for n in m.node_tree.nodes if n.type == "TEX_IMAGE" and n.image is not None
    ]
    assert all(np.allclose(image.pixels[:3], 0.8, atol=0.01) for image in used)
    assert len(asset.warnings) == 1 and "no.png" in asset.warnings[0] and asset.warnings[0].endswith(".")


def test_everything_at_one_point_or_nothing_to_see():
    scene.empty()
    with pytest.raises(InputError, match=r"^x: no mesh is visible.*\.$"):
        scene.normalisation([1], name="x")
    cube().scale = (0, 0, 0)
    with pytest.raises(InputError, match=r"^x: all vertices lie at one point.*\.$"):
        scene.normalisation([1], name="x")


def skinned():
    """A bar, 4 high, which two bones bend: one clip to the side and one to the front."""
    bar = cube("bar", (0, 0, 2))
    bar.scale = (0.25, 0.25, 2)
    bpy.ops.object.transform_apply(location=True)
    bpy.ops.object.armature_add()
    rig = bpy.context.object
    bpy.ops.object.mode_set(mode="EDIT")
    lower = rig.data.edit_bones[0]
    lower.name, lower.head, lower.tail = "lower", (0, 0, 0), (0, 0, 2)
    upper = rig.data.edit_bones.new("upper")
    upper.head, upper.tail, upper.parent = (0, 0, 2), (0, 0, 4), lower
    bpy.ops.object.mode_set(mode="OBJECT")
    for name in ("lower", "upper"):
        high = [v.index for v in bar.data.vertices if (v.co.z > 2) == (name == "upper")]
        bar.vertex_groups.new(name=name).add(high, 1.0, "REPLACE")
    bar.parent = rig
    bar.modifiers.new("skin", "ARMATURE").object = rig
    bone = rig.pose.bones["upper"]
    bone.rotation_mode = "XYZ"
    for name, turned in (("aside", (0, 0, 1)), ("forwards", (0.5, 0, 0))):
        for frame, angles in ((0, (0, 0, 0)), (12, turned)):
            bone.rotation_euler = angles
            bone.keyframe_insert("rotation_euler", frame=frame)
        to_track(rig, name)
        bone.rotation_euler = (0, 0, 0)


def morphing():
    """A cube with several morph targets, which grow in turn."""
    ob = cube()
    ob.shape_key_add(name="Basis")
    for axis in range(3):
        key_block = ob.shape_key_add(name="xyz"[axis])
        for v in key_block.data:
            v.co[axis] *= 2
        key(key_block, "value", {0: 0.0, 6 + axis: 1.0, 12: 0.0})
    to_track(ob.data.shape_keys, "grow")


def parts():
    """A body with a head on it and a wheel, moved as nodes: three clips."""
    body = cube("body")
    others = [cube("head", (0, 0, 2), 1), cube("wheel", (1, 0, -1), 1)]
    for ob in others:
        ob.parent = body
    for name, ob, path, last in (
        ("walk", body, "location", (0, -4, 0)),
        ("nod", others[0], "rotation_euler", (0.7, 0, 0)),
        ("roll", others[1], "rotation_euler", (3.0, 0, 0)),
    ):
        first = tuple(getattr(ob, path))
        key(ob, path, {0: first, 15: last})
        to_track(ob, name)
        setattr(ob, path, first)


@pytest.mark.parametrize(
    ("build", "clips", "most"),
    [(skinned, 2, "aside"), (morphing, 1, "grow"), (parts, 3, "walk")],
    ids=["skin", "morph targets", "nodes"],
)
def test_every_kind_of_animation_of_a_gltf(tmp_path, build, clips, most):
    """Skins, morph targets and node animation survive the way through a file."""
    scene.empty()
    build()
    bpy.context.scene.frame_set(0)
    asset = scene.open_asset(export(tmp_path / "a.glb"))
    assert len(asset.clips) == clips and not asset.warnings
    clip = scene.most_moving(asset)
    asset.play(clip)
    assert clip.name == most and scene.motion(clip.frames(24)) > 0.01
    norm, box = scene.normalisation(clip.frames(24))
    assert np.abs(box).max() == pytest.approx(1) and norm.scale > 0
