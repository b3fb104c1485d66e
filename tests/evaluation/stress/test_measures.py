# SPDX-License-Identifier: GPL-3.0-or-later
"""Measures of the stress suite, by hand."""

import math

import pytest
import torch

from timesplat.evaluation.stress.measures import MEASURES, flicker, ghosts, lost, measured
from timesplat.evaluation.stress.scenes import load_scene, trial_folder

from .conftest import SAMPLES


def test_ghosts_and_their_age():
    truth, shown = torch.zeros(4, 1, 5), torch.zeros(4, 1, 5)
    for t in range(4):
        truth[t, 0, t] = 1  # goes right, a pixel a moment
        shown[t, 0, t] = 1
    assert ghosts(shown, truth)[0] == 0 and math.isnan(ghosts(shown, truth)[1])
    shown[3, 0, 1] = 0.5  # what was here two moments ago is still
    share, age = ghosts(shown, truth)
    assert share == pytest.approx(100 * 0.5 / 4) and age == pytest.approx(2)
    shown[3, 0, 1], shown[0, 0, 4] = 0, 0.5  # what never is anywhere has no age
    share, age = ghosts(shown, truth)
    assert share == pytest.approx(12.5) and math.isnan(age)


def test_flicker():
    truth = torch.full((3, 2, 2, 3), 0.5)
    still = truth + 0.1
    assert flicker(still, truth) == pytest.approx(0, abs=1e-4), "what is wrong but steady does not flicker"
    blinking = truth.clone()
    blinking[1] += 0.2
    assert flicker(blinking, truth) == pytest.approx(255 * 0.2, rel=1e-4)
    assert flicker(torch.ones(3, 2, 2, 3), torch.ones(3, 2, 2, 3)) == 0


def test_where_3_db_are_lost():
    assert lost([0, 1, 2], [30, 28, 24]) == pytest.approx(1.25)
    assert lost([8, 4, 2], [30, 29, 26]) == pytest.approx(4 - 2 * 2 / 3)
    assert lost([0, 1], [30, 28]) is None


def test_the_truth_is_perfect(trial):
    out, condition = trial
    scene = load_scene(trial_folder(out, condition, SAMPLES), condition)
    found, _ = measured(*((t.picture, t.views.alpha) for t in (scene.moments, scene.watch)), scene)
    assert found.keys() <= MEASURES.keys()
    assert found["psnr_worst"] == found["between_worst"] == pytest.approx(100)
    assert found["ghost"] == found["flicker"] == found["flip_worst"] == 0 and found["ssim"] == 1


def test_a_picture_of_another_time_is_found(trial):
    out, condition = trial
    scene = load_scene(trial_folder(out, condition, SAMPLES), condition)
    rgb, alpha = scene.moments.picture.clone(), scene.moments.views.alpha.clone()
    rgb[5] = 1
    late = scene.watch.picture.clone()
    late[2] = late[0]
    found, worst = measured((rgb, alpha), (late, scene.watch.views.alpha), scene)
    assert worst == 5 and found["psnr_worst"] < 20 < found["psnr"] and found["flip_worst"] > 0
    assert found["between_worst"] < 60 and found["at_whole"] == pytest.approx(100)
