# SPDX-License-Identifier: GPL-3.0-or-later
import bpy
import pytest

from timesplat.datagen.scene.borrow import borrowed, shown_objects
from timesplat.datagen.scene.open import empty_session

from ..helpers import cube, key


@pytest.fixture
def scene():
    """Two cubes, one of which moves, and one that is hidden from renders with its collection; a light, a camera."""
    empty_session()
    key(cube("moving"), "location", {1: (0, 0, 0), 9: (8, 0, 0)})
    cube("still")
    bpy.ops.object.light_add(type="SUN")
    bpy.ops.object.camera_add()
    off = bpy.data.collections.new("off")
    bpy.context.scene.collection.children.link(off)
    off.objects.link(bpy.data.objects.new("hidden", bpy.data.objects["still"].data))
    off.hide_render = True
    bpy.context.scene.frame_set(3)
    return bpy.context.scene


def test_what_renders_could_show(scene):
    assert {ob.name for ob in shown_objects(scene, bpy.context.view_layer)} == {"moving", "still", "Sun", "Camera"}


def test_a_copy_holds_what_is_shown_or_asked_for(scene):
    with borrowed() as stage:
        assert {ob.name for ob in stage.collection.objects} == {"moving", "still", "Sun"} and stage != scene
    with borrowed(lights=False) as stage:
        assert {ob.name for ob in stage.collection.objects} == {"moving", "still"}
    with borrowed([bpy.data.objects["hidden"]]) as stage:
        assert [ob.name for ob in stage.collection.objects] == ["hidden"]


def test_the_scene_is_given_back(scene):
    names = [ob.name for ob in scene.objects]
    with pytest.raises(KeyError), borrowed() as stage:
        stage.frame_set(9)
        moving = bpy.data.objects["moving"].evaluated_get(stage.view_layers[0].depsgraph)
        assert moving.matrix_world.translation.x == 8
        raise KeyError
    assert list(bpy.data.scenes) == [scene] and [ob.name for ob in scene.objects] == names
    assert scene.frame_current == 3 and bpy.data.objects["moving"].location.x < 8
