# SPDX-License-Identifier: GPL-3.0-or-later
"""Which views of a Sequence go in and which are scored: the paper's evaluation setups (its section 3).

The Sequences are those of the rig "evaluation" with held-out views (rig "target"): all setups are choices from
them. Those of the small rigs, rendered for one setup alone ("alternating", …), hold its inputs and the targets.

    chosen = inputs(seq, "alternating")       # what the method sees
    scored = targets(seq, stride=1)           # what the paper scores: four canonical views and a random one a frame
    fresh = novel(seq, chosen, scored)        # those of them that the method has not seen

Indices into `seq.views`, in the order of time. numpy only.
"""

from __future__ import annotations

import re

import numpy as np

from ..datagen import rigs
from ..datagen.sequence import HELD_OUT, InputError, Sequence

TABLE = ("alternating", "interpolation", "rotating", "random")  # the columns of the paper's two main tables
FIXED = (*TABLE, "video", "canonical", "split")
FORMS = f"{', '.join(FIXED)}, random-N (N of 1 to 4 a frame) or views-N (N of 1 to 4 times the frames, in all)"
RENDER = "render it with `timesplat render --rig evaluation --targets 1`"
EXACT = 1e-4  # cameras closer than this are the same


def check_setup(setup: str) -> str:
    """The setup's name, if it is one. Raises InputError naming those there are."""
    if setup in FIXED or re.fullmatch(r"random-[1-4]|views-[1-9]\d*", setup):
        return setup
    raise InputError(f"{setup}: no such setup; choose {FORMS}.")


def inputs(seq: Sequence, setup: str) -> list[int]:
    """Input views of a setup. alternating, interpolation, rotating, random, video: see `datagen.rigs.SETUPS`;
    canonical: the four canonical cameras at every frame; split: all that are not held out; random-N: N random
    views a frame; views-N: N random views in all, spread evenly over the clip (views-24 of 24 frames is random).
    Raises InputError for an unknown setup, or where the Sequence lacks a view of it."""
    check_setup(setup)
    if setup == "split":
        return seq.inputs()
    frames = range(seq.frame_start, seq.frame_end + 1)
    if own := seq.select(rig=setup):  # rendered for this setup
        whole = setup != "random" or len({v.camera for v in seq.views if v.rig == "random"}) == 1
        if whole and setup != "canonical":
            return _in_time(seq, own)
    if setup == "rotating":
        wanted = [(s.frame, s.camera, "two_rotating") for s in rigs.two_rotating(frames)]
    elif setup.startswith("random"):
        count = int(setup[7:] or 1)
        wanted = [(f, f"random{i}", "random") for f in frames for i in range(count)]
    elif setup.startswith("views"):
        wanted = [(f, f"random{i}", "random") for f, i in spread(frames, int(setup[6:]))]
    else:
        shots = (rigs.canonical if setup == "canonical" else rigs.SETUPS[setup])(frames, 0)
        wanted = [(s.frame, s.camera, "canonical") for s in shots]
    place = {(v.frame, v.camera, v.rig): i for i, v in enumerate(seq.views)}
    lacking = [w for w in wanted if w not in place]
    if lacking:
        frame, camera, _ = lacking[0]
        raise InputError(
            f"{seq.root}: no view from camera {camera} at frame {frame}, which the setup {setup} needs; "
            "render it with --rig evaluation --targets 1, or take the setup split."
        )
    return [place[w] for w in wanted]


def held_out(seq: Sequence, split: str = "test") -> list[int]:
    """The held-out views of a split of HELD_OUT. Raises InputError where there are none."""
    found = seq.select(rig=HELD_OUT[split])
    if not found:
        raise InputError(f"{seq.root}: no held-out views to score (rig {HELD_OUT[split]}); {RENDER}.")
    return found


def every_nth(seq: Sequence, step: int) -> list[int]:
    """One canonical view at every `step`-th frame: front, left, back, right in turn. Raises InputError."""
    frames = range(seq.frame_start, seq.frame_end + 1, step)
    found = [seq.select(frame=f, camera=list(rigs.CANONICAL)[n % 4], rig="canonical") for n, f in enumerate(frames)]
    if lacking := [f for f, x in zip(frames, found, strict=True) if not x]:
        raise InputError(f"{seq.root}: frame {lacking[0]} lacks a canonical view; {RENDER}.")
    return [x[0] for x in found]


def at_frame(seq: Sequence, frame: int, *names: str) -> list[int]:
    """All views of the rigs `names` at a frame. Raises InputError where there are none."""
    found = [i for name in names for i in seq.select(rig=name, frame=frame)]
    if not found:
        raise InputError(f"{seq.root}: frame {frame} has no view of the rigs {', '.join(names)}; {RENDER}.")
    return found


def spread(frames, count: int) -> list[tuple[int, int]]:
    """(frame, which of its views) of `count` views spread evenly over the frames; from more views than frames on
    every frame has as many as the others, or one more. Raises InputError beyond 4 a frame."""
    if not 1 <= count <= 4 * len(frames):
        raise InputError(f"views-{count}: a clip of {len(frames)} frames has 1 to {4 * len(frames)} of them.")
    if count <= len(frames):
        at = np.round(np.linspace(0, len(frames) - 1, count)).astype(int)
    else:
        at = np.arange(count) * len(frames) // count
    return [(frames[f], int(np.sum(at[:k] == f))) for k, f in enumerate(at)]


def targets(seq: Sequence, stride: int = 1) -> list[int]:
    """The views that the paper scores, four canonical ones and a random one (rig "target") a frame, of every
    stride-th frame from the first on; the held-out ones alone where a Sequence has no canonical views.
    Raises InputError where there is nothing to score."""
    if stride < 1:
        raise InputError(f"--stride {stride}: give 1 or more.")
    scored = [i for i in seq.select(rig="canonical") + seq.select(rig="target") if is_scored(seq, i, stride)]
    if not scored:
        raise InputError(f"{seq.root}: no held-out views to score; render it with --targets 1.")
    return _in_time(seq, scored)


def is_scored(seq: Sequence, index: int, stride: int) -> bool:
    """Whether a view is of every `stride`-th frame of the clip from the first on, or between it and the next frame."""
    return (seq.views[index].frame - seq.frame_start) // 1 % stride == 0


def novel(seq: Sequence, inputs: list[int], targets: list[int]) -> list[int]:
    """Those targets that no input shows: no input view has the same moment and the same camera pose (rotating
    cameras start and end in canonical poses)."""
    seen: dict[float, list[np.ndarray]] = {}
    for i in inputs:
        seen.setdefault(seq.views[i].frame, []).append(seq.views[i].c2w)
    views = ((i, seq.views[i]) for i in targets)
    return [i for i, v in views if all(np.abs(v.c2w - x).max() > EXACT for x in seen.get(v.frame, []))]


def _in_time(seq: Sequence, indices: list[int]) -> list[int]:
    return sorted(indices, key=lambda i: seq.views[i].frame)  # stable: the order within a frame is kept
