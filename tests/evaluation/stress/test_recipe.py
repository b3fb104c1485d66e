# SPDX-License-Identifier: GPL-3.0-or-later
"""Other people's methods: Sequences out, pictures in."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from timesplat.datagen.readers import open_sequence
from timesplat.datagen.sequence import InputError
from timesplat.evaluation.stress.recipe import score, write_scenes
from timesplat.evaluation.stress.scenes import load_scene, trial_folder
from timesplat.evaluation.stress.sweeps import Condition
from timesplat.model.views import load_views

from .conftest import SAMPLES, SIZE


@pytest.fixture
def folder(trial, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "trials").symlink_to(trial[0] / "trials")
    return tmp_path


def test_what_is_written_is_what_methods_see(trial, folder):
    late = Condition(disturbance="mistimed", level=1.0, size=SIZE)
    assert write_scenes(folder / "scenes", folder / "out", [trial[1], late], SAMPLES) == 2
    seq = open_sequence(folder / "scenes" / f"mistimed_1_{SIZE}px" / "inputs")
    views = load_views(seq, range(len(seq.views)))
    scene = load_scene(trial_folder(folder / "out", late, SAMPLES), late)
    assert torch.allclose(views.time, scene.inputs.time, atol=1e-5)
    assert torch.allclose(views.c2w, scene.inputs.c2w, atol=1e-6)
    assert torch.allclose(views.rgb, scene.inputs.rgb, atol=0.5 / 255 + 1e-6)
    asked = json.loads((folder / "scenes" / f"calm_0_{SIZE}px" / "held-out.json").read_text())
    assert len(asked["frames"]) == 12 + 45 and asked["frames"][-1]["time"] == 1


def test_the_truth_scores_as_such_and_what_is_missing_is_named(trial, folder):
    source = trial_folder(folder / "out", trial[1], SAMPLES) / "held-out" / "images"
    pictures = folder / "mine" / trial[1].folder
    shutil.copytree(source, pictures)
    (row,) = score(folder / "mine", "mine", folder / "out", [trial[1]], SAMPLES).values()
    assert row["psnr"] == pytest.approx(100) and row["ghost"] == 0 and row["method"] == "mine"
    first = sorted(pictures.iterdir())[0]
    image = Image.open(first).convert("RGBA")
    opaque = Image.new("RGBA", image.size, "white")
    opaque.alpha_composite(image)
    opaque.convert("RGB").save(first)
    (row,) = score(folder / "mine", "mine", folder / "out", [trial[1]], SAMPLES).values()
    assert row["psnr"] > 45 and row["ghost"] == 0, "RGB over white is as good"
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(first)
    with pytest.raises(InputError, match="8x8, not 32x32"):
        score(folder / "mine", "mine", folder / "out", [trial[1]], SAMPLES)
    first.unlink()
    with pytest.raises(InputError, match="is missing"):
        score(folder / "mine", "mine", folder / "out", [trial[1]], SAMPLES)


def test_a_condition_without_pictures_is_a_failure(trial, folder):
    (folder / "mine").mkdir()
    (row,) = score(Path(folder / "mine"), "mine", folder / "out", [trial[1]], SAMPLES).values()
    assert row["failed"] == "no pictures"
