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
