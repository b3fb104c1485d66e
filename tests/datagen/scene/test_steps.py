# SPDX-License-Identifier: GPL-3.0-or-later
import bpy
import pytest

from timesplat.datagen.scene.open import empty_session
from timesplat.datagen.scene.steps import go_to, lengthen_frames
from timesplat.datagen.sequence import InputError

from ..helpers import cube, key


@pytest.fixture
def scene():
    """A cube whose place says which frame is shown."""
    empty_session()
    key(cube(), "location", {frame: (frame, 0, 0) for frame in range(-10, 40)})
    return bpy.context.scene


def shown():
    return bpy.context.object.evaluated_get(bpy.context.evaluated_depsgraph_get()).matrix_world.translation.x


@pytest.mark.parametrize("step", [1.0, 3.0, 0.5, 10 / 3, 227 / 23, 2**0.5, 3.14159265 / 10])
def test_frames_are_found_and_their_neighbours_are_the_clips(scene, step):
    taken = lengthen_frames(scene, step)
    assert taken == pytest.approx(step, rel=1 / 2000)
    for i in range(3):
        go_to(scene, 1 + i * step, taken)
        assert shown() == pytest.approx(1 + i * step, abs=1e-4)
        scene.frame_set(scene.frame_current + 1, subframe=scene.frame_subframe)
        assert shown() == pytest.approx(1 + (i + 1) * step, abs=step / 2000 + 1e-4)


def test_a_scene_that_was_stretched_is_stretched_further(scene):
    scene.render.frame_map_old, scene.render.frame_map_new = 200, 100
    scene.frame_set(5)
    before = shown()
    go_to(scene, 5, lengthen_frames(scene, 3))
    assert before == 10 and shown() == pytest.approx(10, abs=1e-4)


@pytest.mark.parametrize("step", [1000.0, 1 / 1000])
def test_steps_that_blender_cannot_say(scene, step):
    with pytest.raises(InputError, match=r"motion vectors cannot lead over .* frames in Blender; .*--no-passes\.$"):
        lengthen_frames(scene, step)
