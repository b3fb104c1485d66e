# SPDX-License-Identifier: GPL-3.0-or-later
import bpy

from timesplat.datagen.scene.open import empty_session
from timesplat.datagen.scene.simulate import simulate

from ..helpers import boxes_at, cube


def test_rigid_bodies_become_keyframes():
    empty_session()
    ob = cube(location=(0, 0, 9))
    bpy.ops.rigidbody.object_add()
    simulate(12)
    assert bpy.context.scene.rigidbody_world is None and ob.animation_data.action
    heights = boxes_at([1, 6, 12])[:, 0, 2]
    assert heights[0] > heights[1] > heights[2] and heights[0] - heights[2] > 0.5


def test_nothing_is_played_where_nothing_is_simulated():
    empty_session()
    cube()
    bpy.context.scene.frame_set(5)
    simulate(20)
    assert bpy.context.scene.frame_current == 5
