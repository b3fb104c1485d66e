# SPDX-License-Identifier: GPL-3.0-or-later
"""Trials of the stress suite to Sequences, several in one process: `python -m timesplat.datagen.render_trials
JOBS.json LOG`, started by `timesplat stress`.

JOBS.json is a list of {trial, level, size, samples, every, threads, folder}. Each writes `folder`/inputs, the pictures
of whole moments with depth, motion and surface tracks, and `folder`/held-out: at whole moments a random pose (rig
"target"), and a camera that stands still (rig "watch") at every step between the moments too. A line of JSON goes to
stdout for each that is done, {"written": folder}; what Blender prints goes to the log.
"""

from __future__ import annotations

import json
import os
import sys
from dataclasses import replace
from pathlib import Path

from .rigs import Shot, default_rig, random_poses, spherical, targets
from .sequence import Normalisation
from .zoo.trials import BETWEEN, MOMENTS, STEPS

HALF = ({"front", "back", "elevated", "random0"}, {"left", "right", "orbit", "random1"})  # in turn
SEED = 15  # of cameras; the same for all trials, so that levels differ in nothing else


def input_shots(every: bool) -> list[Shot]:
    """96 views of the moments: eight cameras at each, or in turn (every = False) one half of them and the other."""
    moments = list(range(MOMENTS))
    shots = default_rig(moments, SEED) + random_poses(moments, SEED, per_frame=2)
    shots.sort(key=lambda s: s.frame)
    return [s for s in shots if every or s.camera in HALF[s.frame % 2]]


def held_out_shots() -> list[Shot]:
    """A random pose at each whole moment, and a camera that stands still at every step."""
    at_moments = [replace(s, frame=s.frame * BETWEEN) for s in targets(list(range(MOMENTS)), SEED)]
    watch = [Shot(step, "watch", "watch", spherical(35, 15)) for step in range(STEPS)]
    return sorted(at_moments + watch, key=lambda s: s.frame)


def render_trial(job: dict) -> None:
    """One of the jobs. The trial lies where its design says: the normalised space is the world."""
    from .capture import Subject, capture
    from .render_setup import CaptureSettings
    from .scene.open import empty_session, tool_versions
    from .zoo.build import build_trial

    empty_session()
    told = {"trial": build_trial(job["trial"], job["level"]), "job": job, "asset": job["trial"], **tool_versions()}
    settings = CaptureSettings(size=job["size"], samples=job["samples"], threads=job["threads"], seed=SEED)
    steps = list(range(1, STEPS + 1))
    folder, world = Path(job["folder"]), Normalisation()
    shots = input_shots(job["every"])
    capture(shots, folder / "inputs", Subject(steps[::BETWEEN], world), settings, provenance=told)
    plain = replace(settings, passes=False, tracks=None)
    capture(held_out_shots(), folder / "held-out", Subject(steps, world), plain, provenance=told)


def main(jobs: str, log: str) -> None:
    out = os.fdopen(os.dup(1), "w", buffering=1)
    sink = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(sink, 1)
    os.dup2(sink, 2)
    for job in json.loads(Path(jobs).read_text()):
        render_trial(job)
        print(json.dumps({"written": job["folder"]}), file=out)


if __name__ == "__main__":
    main(*sys.argv[1:])
    os._exit(0)  # Blender's own way out is slow, and can crash after all is written
