# SPDX-License-Identifier: GPL-3.0-or-later
"""What a sample costs, and what it is worth: Cycles samples a pixel against seconds an image, and against PSNR to
pictures of 512 samples.

    python -m timesplat.benchmarks.renderer zoo:SEED CORE     # one object, JSON on its last line

`timesplat bench` runs it, an object in a process of its own. The rig is that of the training data: six cameras a frame
in one multi-view render, with depth and motion vectors, 128x128, over the same four frames at every number of
samples. Seconds are the processor's of one thread, of the last three frames: the first one holds the start of Cycles.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from timesplat.datagen.sequence import InputError

OBJECTS = ["zoo:1000100", "zoo:1000102"]
SAMPLES = (1, 2, 4, 8, 16, 32, 64)
TRUTH = 512
FRAMES = (1, 7, 13, 19)  # of the zoo's clips of 24
COLUMNS = ["object", "samples", "seconds", "psnr"]


def measure(asset: str, size: int = 128, samples=SAMPLES, truth: int = TRUTH, frames=FRAMES) -> list[dict]:
    """Rows of COLUMNS of a zoo object. In a process with bpy: it empties the scene."""
    from timesplat.datagen.capture import Subject, capture
    from timesplat.datagen.render_setup import CaptureSettings
    from timesplat.datagen.rigs import RIGS
    from timesplat.datagen.scene.measure import normalisation
    from timesplat.datagen.scene.open import empty_session
    from timesplat.datagen.zoo.build import build_object

    empty_session()
    build_object(int(asset.removeprefix("zoo:")))
    norm, _ = normalisation(list(range(1, 25)), name=asset)
    subject = Subject(list(frames), norm)
    shots = RIGS["default"](range(len(frames)), 0)

    def shoot(n: int, seed: int) -> tuple[float, np.ndarray]:
        """-> seconds an image, pictures (V,H,W,3) over white."""
        times = []
        with tempfile.TemporaryDirectory() as folder:
            settings = CaptureSettings(size=size, samples=n, threads=1, seed=seed)
            seq = capture(
                shots, Path(folder) / "s", subject, settings,
                progress=lambda done, total: times.append((time.process_time(), done)),
            )  # fmt: skip
            pictures = np.stack([seq.load_image(i) for i in range(len(seq.views))]).astype(np.float64) / 255
        (a, first), (b, last) = times[0], times[-1]
        return (b - a) / max(last - first, 1), pictures[..., :3] * pictures[..., 3:] + 1 - pictures[..., 3:]

    shoot(1, 0)  # what Blender does once
    _, reference = shoot(truth, 1000)  # another seed: the samples compared with are not among its own
    rows = []
    for n in samples:
        seconds, pictures = shoot(n, 0)
        error = np.square(pictures - reference).mean((1, 2, 3))
        psnr = float(np.mean(-10 * np.log10(np.maximum(error, 1e-10))))
        rows.append({"object": asset.replace(":", "-"), "samples": n, "seconds": seconds, "psnr": psnr})
    return rows


def start(asset: str, core: int | None = None) -> subprocess.Popen:
    """`measure` in a child process, on one core."""
    command = [sys.executable, "-m", __spec__.name if __spec__ else __name__, asset]
    command += [] if core is None else [str(core)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finish(child: subprocess.Popen, asset: str) -> list[dict]:
    """Rows of a `start`. Raises InputError where it died."""
    out, err = child.communicate()
    if child.returncode:
        last = (err.strip() or out.strip() or "no word").splitlines()[-1]
        raise InputError(f"{asset}: the renderer could not be measured: {last}")
    return json.loads(out.strip().splitlines()[-1])


def main(asset: str, core: str = "") -> int:
    if core and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {int(core)})  # before Blender starts its threads
    print("\n" + json.dumps(measure(asset)), flush=True)
    return 0


if __name__ == "__main__":
    status = main(*sys.argv[1:])
    os._exit(status)  # Blender's own way out is slow
