# SPDX-License-Identifier: GPL-3.0-or-later
"""The trials of the stress suite on disk, rendered where they are not yet, and what a condition makes of one."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import zlib
from collections.abc import Iterable
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from ...datagen.sequence import InputError, Sequence, read_sequence
from ...datagen.zoo.trials import BETWEEN, VERSION
from ...model.views import Views, load_views
from ..loading import Truth, load_truth
from .sweeps import SWEEPS, Condition


@dataclass
class Scene:
    """What methods see of a condition, and what they are compared with."""

    inputs: Views  # with depth, motion and surface tracks
    cameras: np.ndarray  # (V,) numbers the camera of each input of the whole trial, before any was left out
    moments: Truth  # at whole moments: random poses, and the camera that stands still
    watch: Truth  # the camera that stands still, at every step from the first to the last
    names: list[str]  # of the held-out pictures: those of `moments`, then of `watch`


def trial_folder(out: Path, condition: Condition, samples: int) -> Path:
    """Where the trial of a condition lies below `out`."""
    name = f"{condition.trial}_{condition.trial_level:g}_{condition.size}px_{samples}spp"
    return out / "trials" / (name + ("_all" if condition.all_views else ""))


def render(out: Path, conditions: Iterable[Condition], samples: int, jobs: int = 1) -> None:
    """Renders the trials of the conditions that are not there whole, in `jobs` processes of one thread each. Raises
    InputError where Blender is not installed or dies."""
    wanted = {trial_folder(out, c, samples): c for c in conditions}
    todo = [
        {
            "trial": c.trial, "level": c.trial_level, "size": c.size, "samples": samples, "every": c.all_views,
            "threads": 1 if jobs > 1 else 0, "folder": str(folder),
        }
        for folder, c in wanted.items() if not _is_whole(folder)
    ]  # fmt: skip
    if not todo:
        return
    if not find_spec("bpy"):
        raise InputError("stress: its scenes are rendered by Blender; pip install 'timesplat[render]'.")
    parts = [part for part in (todo[i::jobs] for i in range(jobs)) if part]
    with tempfile.TemporaryDirectory(prefix="timesplat-") as tmp:
        children = [_start(Path(tmp) / str(n), part) for n, part in enumerate(parts)]
        try:
            with tqdm(total=len(todo), desc="rendering", unit="trial", disable=None) as bar:
                _wait(children, bar)
        finally:
            for child in children:
                child.kill()
                child.wait()
        for n, child in enumerate(children):
            if child.returncode:
                log = Path(tmp) / f"{n}.log"
                lines = log.read_text(errors="replace").strip().splitlines() if log.exists() else []
                last = f" (last line: {lines[-1][:200]})" if lines else ""
                raise InputError(f"{out}: Blender died over a trial{last}; run the command again, which goes on.")


def _start(stem: Path, jobs: list[dict]) -> subprocess.Popen:
    file = stem.with_suffix(".json")
    file.write_text(json.dumps(jobs))
    command = [sys.executable, "-m", "timesplat.datagen.render_trials", str(file), str(stem.with_suffix(".log"))]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stdin=subprocess.DEVNULL, text=True)


def _wait(children: list[subprocess.Popen], bar: tqdm) -> None:
    """Until all of them have ended; each line of theirs is a trial."""
    from threading import Thread

    def follow(child: subprocess.Popen) -> None:
        for _ in child.stdout or ():
            bar.update()

    threads = [Thread(target=follow, args=(child,)) for child in children]
    for thread in threads:
        thread.start()
    for thread, child in zip(threads, children, strict=True):
        thread.join()
        child.wait()


def _is_whole(folder: Path) -> bool:
    try:
        told = [read_sequence(folder / part).provenance["trial"]["version"] for part in ("inputs", "held-out")]
    except (InputError, KeyError, OSError):
        return False
    return told == [VERSION, VERSION]


def load_scene(folder: Path, condition: Condition) -> Scene:
    """A condition on its trial's folder. Raises InputError where that is not whole."""
    inputs, held_out = read_sequence(folder / "inputs"), read_sequence(folder / "held-out")
    views = load_views(inputs, range(len(inputs.views)), has_depth=all(v.passes for v in inputs.views))
    names = sorted({v.camera for v in inputs.views})
    cameras = np.array([names.index(v.camera) for v in inputs.views])
    moments = [i for i, v in enumerate(held_out.views) if v.frame % BETWEEN == 0]
    watch = held_out.select(rig="watch")
    files = [held_out.views[i].image for i in moments + watch]
    at_moments, watched = (load_truth(held_out, chosen, chosen) for chosen in (moments, watch))
    return Scene(disturbed(views, cameras, condition), cameras, at_moments, watched, files)


def disturbed(views: Views, cameras: np.ndarray, condition: Condition) -> Views:
    """The views as the condition has them; what is random is drawn from the sweep's name and, where levels are repeats,
    the level: harder levels are the same draws, stronger."""
    if not condition.disturbance:
        return views
    sweep = SWEEPS[condition.disturbance]
    seed = [zlib.crc32(sweep.name.encode()), round(condition.level) if sweep.repeats else 0]
    assert sweep.disturb
    found = sweep.disturb(views, cameras, condition.level, np.random.default_rng(seed))
    if found.depth is not None:  # what a mask that is too large adds has no surface
        found = replace(found, depth=torch.where(found.alpha > 0, found.depth, torch.inf))
    return found


def held_out_sequence(folder: Path) -> Sequence:
    """The cameras and times that a method is asked for."""
    return read_sequence(folder / "held-out")
