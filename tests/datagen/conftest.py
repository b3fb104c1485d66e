# SPDX-License-Identifier: GPL-3.0-or-later
"""A file that several modules' tests open."""

import bpy
import pytest

from timesplat.datagen.scene.open import empty_session

from .helpers import cube, export_glb, key, to_track


@pytest.fixture(scope="session")
def two_clips(tmp_path_factory):
    """Two cubes with two clips: "slide" moves both over 10 frames, "grow" only one of them and a shape key."""
    empty_session()
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
    return export_glb(tmp_path_factory.mktemp("clips") / "two.glb")


@pytest.fixture(scope="session")
def small_assets(tmp_path_factory):
    """A folder with a moving cube of two clips, a cube that stands still, and a file that is cut."""
    folder = tmp_path_factory.mktemp("assets")
    empty_session()
    bpy.ops.mesh.primitive_cube_add()
    ob = bpy.context.object
    for name, way in (("short way", 1), ("long way", 3)):
        for frame in (0, 10):
            ob.location = (way * frame / 10, 0, 0)
            ob.keyframe_insert("location", frame=frame)
        action = ob.animation_data.action
        track = ob.animation_data.nla_tracks.new()
        track.name = name
        track.strips.new(name, 0, action)
        ob.animation_data.action = None
    options = {"export_animation_mode": "NLA_TRACKS"}
    bpy.ops.export_scene.gltf(filepath=str(folder / "moving.glb"), **options)
    ob.animation_data_clear()
    bpy.ops.export_scene.gltf(filepath=str(folder / "still.glb"), **options)
    whole = (folder / "moving.glb").read_bytes()
    (folder / "cut.glb").write_bytes(whole[: len(whole) // 2])
    return folder
