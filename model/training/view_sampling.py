# SPDX-License-Identifier: GPL-3.0-or-later
"""Which views of a clip a training sample takes. Only numbers: no images are read here."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ...datagen.rigs import CANONICAL
from ...datagen.sequence import InputError

DEFAULT_COUNTS = {"setups": (24, 8), "paper": (12, 24), "video": (27, 8), "static": (4, 4)}  # inputs, targets
PAPER_POOL = 36  # views that a sample of `paper` is drawn from
# How `setups` chooses the inputs, and how often. Every one gives a view for each frame, as the paper's evaluation
# setups do; `every` takes any camera at each frame.
INPUT_PATTERNS = {"alternating": 0.4, "interpolation": 0.1, "moving": 0.15, "every": 0.35}


@dataclass
class ClipLayout:
    """The views of a clip as numbers (V,): frame 0.., camera as an index into names; name says which clip."""

    frame: np.ndarray
    camera: np.ndarray
    names: list[str]
    name: str = "clip"

    @property
    def canonical(self) -> np.ndarray:
        """(V,) bool: taken by one of the four canonical cameras."""
        return np.isin(self.camera, [self.names.index(c) for c in CANONICAL if c in self.names])


def sample_views(
    sampling: str, rng: np.random.Generator, clip: ClipLayout, inputs: int, targets: int
) -> tuple[np.ndarray, np.ndarray]:
    """Indices of at most `inputs` input views in the order of time, and of at most `targets` target views. sampling:

    setups  inputs as the paper's evaluation setups have them, targets among the other views
    paper   36 views at random; inputs and targets are drawn from them independently, so they may overlap (4.1)
    video   the four canonical views of the first frame and the front view of each frame (4.1, free Gaussians)
    static  inputs and targets at one frame, which may overlap: the object as if it never moved (GS-LRM)

    Raises InputError where the clip lacks the views that the sampling needs."""
    return SAMPLERS[sampling](rng, clip, inputs, targets)


def _setups(rng, clip: ClipLayout, inputs: int, targets: int):
    """Targets are other views than the inputs (any where there are no others), those from moving cameras three
    times as likely as those from the canonical four."""
    chosen = sample_setup_inputs(rng, clip, inputs)
    weight = np.where(clip.canonical, 1.0, 3.0)
    if len(chosen) < len(weight):
        weight[chosen] = 0
    count = min(targets, np.count_nonzero(weight))
    return chosen, rng.choice(len(weight), count, replace=False, p=weight / weight.sum())


def _paper(rng, clip: ClipLayout, inputs: int, targets: int):
    pool = _draw(rng, np.arange(len(clip.frame)), max(PAPER_POOL, inputs, targets))
    return _in_time(clip, _draw(rng, pool, inputs)), _draw(rng, pool, targets)


def _video(rng, clip: ClipLayout, inputs: int, targets: int):
    """With fewer than 4 + frames - 1 inputs the video skips frames evenly."""
    first = clip.frame == clip.frame.min()
    front = clip.names.index("front") if "front" in clip.names else -1
    start, later = np.flatnonzero(first & clip.canonical), np.flatnonzero(~first & (clip.camera == front))
    if len(start) < 4 or not len(later):
        raise InputError(
            f"{clip.name}: --sampling video needs the four canonical views of the first frame and a front view of "
            "the others; render it with --rig default."
        )
    later = _in_time(clip, later)
    keep = np.unique(np.linspace(0, len(later) - 1, max(inputs - 4, 1)).round().astype(int))
    return _in_time(clip, np.concatenate([start, later[keep]])), _draw(rng, np.arange(len(clip.frame)), targets)


def _static(rng, clip: ClipLayout, inputs: int, targets: int):
    """A frame that has at least `inputs` views, where there is one; else the one with the most."""
    frames, counts = np.unique(clip.frame, return_counts=True)
    rich = frames[counts >= min(inputs, counts.max())]
    here = np.flatnonzero(clip.frame == rng.choice(rich))
    return np.sort(_draw(rng, here, inputs)), _draw(rng, here, targets)


SAMPLERS: dict[str, Callable] = {"setups": _setups, "paper": _paper, "video": _video, "static": _static}


def sample_setup_inputs(rng: np.random.Generator, clip: ClipLayout, count: int) -> np.ndarray:
    """Indices of the input views of a `setups` sample: at most `count`, in the order of time. Of the pattern's cameras
    those are taken that have a view at the frame; all that have one where none of them does."""
    patterns = list(INPUT_PATTERNS)
    pattern = patterns[rng.choice(len(patterns), p=list(INPUT_PATTERNS.values()))]
    canonical = clip.canonical
    wanted = {"moving": ~canonical, "every": np.ones_like(canonical)}.get(pattern, canonical)
    start = rng.integers(len(clip.names))
    found: list[int] = []
    for n, t in enumerate(np.unique(clip.frame)):
        here = np.flatnonzero(clip.frame == t)
        pool = here[wanted[here]] if wanted[here].any() else here
        pool = sorted(pool, key=lambda i: _camera_order(clip.names[clip.camera[i]]))
        turn = rng.integers(len(pool)) if pattern == "every" else start + n
        if pattern != "interpolation":
            found.append(pool[turn % len(pool)])
        elif n % 2 == 0:
            found += {pool[(turn + k) % len(pool)] for k in (0, 1)}
    if len(found) > count:
        found = [found[i] for i in np.sort(rng.choice(len(found), count, replace=False))]
    return np.array(found)


def _camera_order(name: str) -> tuple:
    """Canonical cameras in their cyclic order first, then the others by name."""
    return (list(CANONICAL).index(name), "") if name in CANONICAL else (len(CANONICAL), name)


def _draw(rng, pool: np.ndarray, count: int) -> np.ndarray:
    """At most `count` of a pool (n,), without repetition."""
    return rng.choice(pool, min(count, len(pool)), replace=False)


def _in_time(clip: ClipLayout, indices: np.ndarray) -> np.ndarray:
    """Views (n,) in the order of frames, and of cameras within one."""
    return indices[np.lexsort((clip.camera[indices], clip.frame[indices]))]
