# SPDX-License-Identifier: GPL-3.0-or-later
"""Scenes of conditions: what is read, what is disturbed, what is rendered again."""

from dataclasses import replace

import pytest
import torch

from timesplat.datagen.sequence import InputError
from timesplat.datagen.zoo.trials import BETWEEN, MOMENTS, STEPS
from timesplat.evaluation.stress import scenes
from timesplat.evaluation.stress.scenes import load_scene, render, trial_folder

from .conftest import SAMPLES


def load(trial, **how):
    out, condition = trial
    return load_scene(trial_folder(out, condition, SAMPLES), replace(condition, **how))


def test_a_scene(trial):
    scene = load(trial)
    assert len(scene.inputs) == 2 * MOMENTS == len(scene.cameras) and scene.inputs.frame_step == pytest.approx(2 / 11)
    assert len(scene.moments.picture) == 2 * MOMENTS and len(scene.watch.picture) == STEPS
    assert torch.equal(scene.watch.views.time[::BETWEEN].unique(), scene.moments.views.time.unique())
    assert len(scene.names) == 2 * MOMENTS + STEPS


def test_harder_levels_are_the_same_draws_stronger(trial):
    calm, one, two = (load(trial, disturbance="misplaced", level=x).inputs.c2w[:, :3, 3] for x in (0.0, 1.0, 2.0))
    assert torch.allclose(2 * (one - calm), two - calm, atol=1e-5)
    first, second = (load(trial, disturbance="shuffled", level=x).inputs.rgb for x in (1.0, 2.0))
    assert not torch.equal(first, second), "repeats are other draws"


def test_depth_ends_where_a_hole_is(trial):
    holed = load(trial, disturbance="holed", level=50.0).inputs
    assert torch.isinf(holed.depth[holed.alpha == 0]).all() and torch.isfinite(holed.depth).any()


def test_what_is_there_is_not_rendered_again(trial, monkeypatch):
    out, condition = trial
    monkeypatch.setattr(scenes, "_start", lambda *_: pytest.fail("rendered"))
    render(out, [condition], SAMPLES)
    (trial_folder(out, condition, SAMPLES) / "held-out" / "transforms.json").rename(out / "aside")
    try:
        monkeypatch.setattr(scenes, "find_spec", lambda name: None)
        with pytest.raises(InputError, match="rendered by Blender"):
            render(out, [condition], SAMPLES)
    finally:
        (out / "aside").rename(trial_folder(out, condition, SAMPLES) / "held-out" / "transforms.json")


def test_blender_that_dies_is_a_sentence(tmp_path, monkeypatch):
    from timesplat.evaluation.stress.sweeps import Condition

    pytest.importorskip("bpy")
    monkeypatch.setattr(scenes.sys, "executable", "false")
    with pytest.raises(InputError, match="goes on"):
        render(tmp_path, [Condition()], 1)
