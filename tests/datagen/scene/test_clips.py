# SPDX-License-Identifier: GPL-3.0-or-later
import bpy
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from timesplat.datagen.render_asset import most_moving_clip
from timesplat.datagen.scene.clips import Clip, changes_looks
from timesplat.datagen.scene.measure import motion, normalisation
from timesplat.datagen.scene.open import empty_session, open_asset

from ..helpers import boxes_at, cube, export_glb, key, to_track


def test_tracks_named_alike_are_one_clip(two_clips):
    asset = open_asset(two_clips)
    assert {c.name: (c.frame_start, c.frame_end, len(c.actions)) for c in asset.clips} == {
        "slide": (0, 10, 2),
        "grow": (0, 30, 2),
    }
    assert len(asset.sha256) == 64 and not asset.warnings
    assert {o.type for o in bpy.data.objects} == {"MESH"}  # no lights, no cameras


def test_clips_play_whole_and_leave_nothing_behind(two_clips):
    asset = open_asset(two_clips)
    by_name = {c.name: c for c in asset.clips}
    for _ in range(2):  # from either clip to the other
        asset.play(by_name["slide"])
        low, high = boxes_at([0, 10]).swapaxes(0, 1)
        assert high[0].tolist() == [1, 5, 1] and high[1].tolist() == [6, 10, 1]
        asset.play(by_name["grow"])
        low, high = boxes_at([0, 30]).swapaxes(0, 1)
        assert low[0].tolist() == [-1, -1, -1] and high[0].tolist() == [1, 5, 1]
        assert high[1].tolist() == [3, 7, 3]
        asset.play(by_name["grow"])


def test_frames_from_a_start_on_by_a_step_or_spread():
    clip = Clip("x", 10, 30)
    assert clip.frames(4, start=5, every=3) == [15, 18, 21, 24] and clip.frames(4, every=9) == [10, 19, 28, 30]
    assert clip.frames(5, spread=True) == [10, 15, 20, 25, 30] and clip.frames(1, spread=True) == [10]
    assert clip.frames(3, start=19, spread=True) == [29, 29.5, 30]
    assert all(type(f) is int for f in clip.frames(5, spread=True))
    assert clip.frames(3, start=20) == [30] and clip.frames(3, start=21) == []


@given(st.integers(1, 90), st.integers(1, 12), st.integers(1, 3), st.integers(0, 30))
def test_consecutive_clips_lose_nothing(length, count, every, start):
    """Each frame that a step meets is in one of them, in order, but for a single one left at the end."""
    clip = Clip("x", 7, 7 + length - 1)
    parts = clip.cut(count, start=start, every=every)
    shown = [f for part in parts for f in dict.fromkeys(part.frames(count, every=every))]
    met = list(range(7 + start, 7 + length, every))
    assert met == [f for f in met if f in shown] or (len(met) % count == 1 and set(met[:-1]) <= set(shown))
    assert shown == sorted(set(shown)) and len({part.name for part in parts}) == len(parts)
    assert all(len(part.frames(count, every=every)) in (1, count) for part in parts)
    assert [part.name for part in parts] == ["x"] * len(parts) or len(parts) > 1


def test_names_of_consecutive_clips():
    parts = Clip("Run", 1, 50).cut(24)
    assert [(p.name, p.frame_start, p.frame_end) for p in parts] == [
        ("Run 01", 1, 24),
        ("Run 02", 25, 48),
        ("Run 03", 49, 50),
    ]
    assert [p.frames(24)[-1] for p in parts] == [24, 48, 50]
    assert [(p.name, p.frame_start, p.frame_end) for p in Clip("Run", 1, 25).cut(24)] == [("Run", 1, 24)]


def test_frames_are_padded_by_the_last(two_clips):
    clips = {c.name: c for c in open_asset(two_clips).clips}
    assert clips["slide"].frames(24) == [*range(11), *[10] * 13]
    assert clips["grow"].frames(24) == list(range(24))
    assert Clip("x", 5, 5).frames(24) == [5]


def test_a_static_asset_is_one_frame(tmp_path):
    empty_session()
    cube()
    asset = open_asset(export_glb(tmp_path / "still.glb"))
    assert [(c.name, c.frames(24)) for c in asset.clips] == [("static", [1])]
    asset.play(asset.clips[0])
    assert normalisation([1])[0].scale == pytest.approx(np.sqrt(3) / 1.1)


def test_blend_shows_its_scene_then_its_other_actions_and_never_runs_scripts(tmp_path):
    empty_session()
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
    asset = open_asset(tmp_path / "a.blend")
    assert not (tmp_path / "ran").exists()
    assert [(c.name, c.frame_start, c.frame_end) for c in asset.clips] == [("scene", 1, 20), ("spare", 5, 9)]
    asset.play(asset.clips[0])
    assert boxes_at([20])[0, 1].tolist() == [3, 1, 1]
    asset.play(asset.clips[1])
    assert boxes_at([9])[0, 1].tolist() == [2, 2, 2]  # grown, and back at its place


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
    empty_session()
    build()
    bpy.context.scene.frame_set(0)
    asset = open_asset(export_glb(tmp_path / "a.glb"))
    assert len(asset.clips) == clips and not asset.warnings
    clip = most_moving_clip(asset)
    asset.play(clip)
    assert clip.name == most and motion(clip.frames(24)) > 0.01
    norm, box = normalisation(clip.frames(24))
    assert 0.6 < np.abs(box).max() <= 1 + 1e-6 and norm.scale > 0


# ---------------------------------------------------------------- what animates lights and cameras


def fly(ob, frames=(1, 12)):
    key(ob, "location", {frames[0]: (0, 0, 0), frames[1]: (9, 9, 9)})
    return ob.animation_data.action


def lamp_and_camera():
    """A light and a camera, each on a path of its own; their actions."""
    bpy.ops.object.light_add(type="POINT")
    lamp = fly(bpy.context.object)
    bpy.ops.object.camera_add()
    return lamp, fly(bpy.context.object)


def save(path, kind):
    """Writes the scene as a file of that kind."""
    if kind == "blend":
        bpy.ops.wm.save_as_mainfile(filepath=str(path))
    elif kind == "fbx":
        bpy.ops.export_scene.fbx(filepath=str(path))
    else:
        bpy.context.scene.frame_set(1)
        bpy.ops.export_scene.gltf(
            filepath=str(path), export_animation_mode="ACTIONS", export_lights=True, export_cameras=True
        )
    return path


@pytest.mark.parametrize("kind", ["blend", "glb", "fbx"])
@pytest.mark.parametrize("moves", [False, True], ids=["still", "turning"])
def test_the_path_of_a_camera_moves_nothing_else(tmp_path, kind, moves):
    empty_session()
    ob = cube()
    if moves:
        key(ob, "rotation_euler", {1: (0, 0, 0), 12: (0, 0, 0.5)})
    lamp_and_camera()
    asset = open_asset(save(tmp_path / f"a.{kind}", kind))
    assert {o.type for o in bpy.data.objects} == {"MESH"}
    owners = {owner.name for clip in asset.clips for owner, *_ in clip.actions}
    assert owners <= ({"Cube"} if moves else set())
    clip = most_moving_clip(asset)
    asset.play(clip)
    moved = motion(clip.frames(12))
    assert 0.1 < moved < 1 if moves else moved == 0
    assert len(asset.clips) == 1 and (moves or clip.name == "static")


@pytest.mark.parametrize("named", [True, False])
def test_an_action_whose_owner_was_deleted_long_ago(tmp_path, named):
    """A path alone says not whose it is; where the file holds two objects it is nobody's, unless one bears its name."""
    empty_session()
    bpy.ops.object.camera_add()
    bpy.context.object.name = "B" if named else "Camera"
    action = fly(bpy.context.object)
    action.use_fake_user = True
    bpy.data.objects.remove(bpy.context.object)
    cube("A"), cube("B", (0, 5, 0))
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    clips = open_asset(tmp_path / "a.blend").clips
    owners = [owner.name for clip in clips for owner, *_ in clip.actions]
    if hasattr(bpy.types.Action, "slots"):
        assert owners == (["B"] if named else [])


def test_an_action_follows_an_object_that_was_renamed(tmp_path):
    empty_session()
    ob = cube("A")
    cube("other")
    action = fly(ob)
    action.use_fake_user = True
    ob.animation_data.action = None
    ob.name = "Z"
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    clips = open_asset(tmp_path / "a.blend").clips
    if hasattr(bpy.types.Action, "slots"):
        assert [owner.name for clip in clips for owner, *_ in clip.actions] == ["Z"]


def test_clips_that_change_looks():
    empty_session()
    cube().data.materials.append(bpy.data.materials.new("m"))
    assert not changes_looks(Clip("scene", 1, 9))
    tree = bpy.data.materials["m"].node_tree
    tree.nodes["Principled BSDF"].inputs["Roughness"].keyframe_insert("default_value", frame=1)
    assert changes_looks(Clip("scene", 1, 9)) and changes_looks(Clip("x", 1, 9, [(tree, None, None)]))
    assert not changes_looks(Clip("x", 1, 9, [(bpy.data.objects["Cube"], None, None)]))
