# SPDX-License-Identifier: GPL-3.0-or-later
"""Trials through Blender: what inputs show, what is held out, and that the two agree."""

import json
import subprocess
import sys

import numpy as np
import pytest

from timesplat.datagen.render_trials import HALF, held_out_shots, input_shots
from timesplat.datagen.sequence import read_sequence
from timesplat.datagen.zoo.trials import BETWEEN, MOMENTS, STEPS


def test_cameras():
    every, half, held_out = input_shots(True), input_shots(False), held_out_shots()
    assert len(every) == 8 * MOMENTS and len(half) == 4 * MOMENTS
    assert {s.camera for s in every} == HALF[0] | HALF[1]
    assert len(held_out) == MOMENTS + STEPS and sum(s.frame % BETWEEN == 0 for s in held_out) == 2 * MOMENTS
    poses = np.stack([s.c2w for s in every])
    assert all(np.abs(poses - s.c2w).max((1, 2)).min() > 1e-3 for s in held_out), "no input shows what is held out"


def test_a_trial_is_two_sequences(tmp_path):
    pytest.importorskip("bpy")
    job = {"trial": "glass", "level": 0.5, "size": 16, "samples": 1, "every": False, "threads": 1}
    (tmp_path / "jobs.json").write_text(json.dumps([job | {"folder": str(tmp_path / "t")}]))
    command = [sys.executable, "-m", "timesplat.datagen.render_trials", tmp_path / "jobs.json", tmp_path / "log"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, (tmp_path / "log").read_text()
    assert json.loads(done.stdout) == {"written": str(tmp_path / "t")}
    inputs, held_out = read_sequence(tmp_path / "t" / "inputs"), read_sequence(tmp_path / "t" / "held-out")
    assert len(inputs.views) == 4 * MOMENTS and len(held_out.views) == MOMENTS + STEPS
    assert inputs.tracks and inputs.views[0].passes and not held_out.views[0].passes
    assert (inputs.frame_end, held_out.frame_end) == (MOMENTS - 1, STEPS - 1)
    assert held_out.model_time(BETWEEN) == pytest.approx(inputs.model_time(1))
    assert inputs.provenance["trial"]["trial"] == "glass" and inputs.normalisation.scale == 1.0
    # its centre is seen through, and yet it is there
    alpha = inputs.load_image(0)[8, 8, 3]
    assert 100 < alpha < 255
