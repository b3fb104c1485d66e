# SPDX-License-Identifier: GPL-3.0-or-later
import bpy
import pytest

from timesplat.datagen.render_setup import CaptureSettings, add_even_light, apply_settings, temporary_data
from timesplat.datagen.scene.open import empty_session


@pytest.mark.parametrize("size", [(40, 30), 24])
def test_the_scene_renders_as_the_settings_say(size):
    empty_session()
    scene = bpy.context.scene
    scene.render.use_border, scene.cycles.use_denoising, scene.cycles.samples = True, True, 99
    scene.view_layers[0].use_pass_normal = True
    apply_settings(scene, CaptureSettings(size, samples=3, passes=size == 24, threads=2))
    render, layer = scene.render, scene.view_layers[0]
    assert (render.resolution_x, render.resolution_y) == ((40, 30) if size != 24 else (24, 24))
    assert (render.engine, scene.cycles.samples, render.threads) == ("CYCLES", 3, 2)
    assert not (render.use_border or scene.cycles.use_denoising or layer.use_pass_normal)
    assert layer.use_pass_z == layer.use_pass_vector == (size == 24)


def test_the_even_light_goes_as_it_came():
    empty_session()
    with temporary_data() as temporary:
        add_even_light(bpy.context.scene, temporary)
        assert len(bpy.data.lights) == 3 and bpy.context.scene.world in temporary
    assert not (len(bpy.data.lights) or len(bpy.data.worlds) or len(bpy.data.objects))
