# SPDX-License-Identifier: GPL-3.0-or-later
"""A trial of the stress suite without Blender: three spheres, ray-traced."""

import numpy as np
import pytest
import torch
from PIL import Image

from timesplat.datagen.passes import Passes, write_passes
from timesplat.datagen.sequence import Sequence, View, opengl_to_opencv, write_sequence
from timesplat.datagen.zoo.trials import BETWEEN, MOMENTS, STEPS, VERSION
from timesplat.evaluation.stress.scenes import trial_folder
from timesplat.evaluation.stress.sweeps import Condition

SIZE, SAMPLES = 32, 1


def write(views, frames, rigs, folder, count, depth):
    seq = Sequence(SIZE, SIZE, 6.0, 0, count - 1, provenance={"trial": {"version": VERSION}})
    for i, (frame, rig) in enumerate(zip(frames, rigs, strict=True)):
        c2w = opengl_to_opencv(views.c2w[i].double().numpy())
        seq.views.append(View(frame, f"{rig}{i % 4}", rig, c2w, *map(float, views.intrinsics[i])))

    def fill(root):
        for name in ("images", "passes"):
            (root / name).mkdir()
        for i, view in enumerate(seq.views):
            view.image = f"images/{view.rig}_{i:03d}.png"
            rgba = torch.cat([views.rgb[i], views.alpha[i][..., None]], -1)
            Image.fromarray((rgba * 255).round().to(torch.uint8).numpy()).save(root / view.image)
            if depth:
                view.passes = f"passes/{i:03d}.exr"
                flow = views.flow[i].numpy()
                write_passes(root / view.passes, Passes(views.depth[i].numpy(), flow[..., :2], flow[..., 2:]))

    write_sequence(seq, folder, fill)


@pytest.fixture(scope="session")
def trial(spheres, tmp_path_factory):
    """A folder of the suite in which the trial `calm` is rendered; its condition, with SAMPLES."""
    out, condition = tmp_path_factory.mktemp("stress"), Condition(size=SIZE)
    folder = trial_folder(out, condition, SAMPLES)
    moments = [m for m in range(MOMENTS) for _ in range(2)]
    cameras = [(90 * (m + 2 * k), 0) for m in range(MOMENTS) for k in range(2)]
    inputs = spheres(moments, cameras, SIZE, MOMENTS)
    write(inputs, moments, ["input"] * len(moments), folder / "inputs", MOMENTS, True)
    steps = [s * BETWEEN for s in range(MOMENTS)] + list(range(STEPS))
    rigs = ["target"] * MOMENTS + ["watch"] * STEPS
    rng = np.random.default_rng(0)
    cameras = [(rng.uniform(0, 360), 20) for _ in range(MOMENTS)] + [(35, 15)] * STEPS
    write(spheres([s / BETWEEN for s in steps], cameras, SIZE, MOMENTS), steps, rigs, folder / "held-out", STEPS, False)
    return out, condition
