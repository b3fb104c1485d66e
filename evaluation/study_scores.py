# SPDX-License-Identifier: GPL-3.0-or-later
"""What studies share: their options, the scores of methods over conditions, and cells of tables."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as Indices
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..datagen.readers import open_sequence, sequences_in
from ..datagen.sequence import InputError, Sequence
from ..model.views import load_views
from . import protocol
from .cache import Cache, name_sequences
from .method_spec import MethodSpec
from .metrics import METRICS
from .provenance import Provenance
from .runner import Conditions, Run, run_all
from .scoring import reconstruct


@dataclass
class StudyOptions:
    """What a study is made of; each uses its part of it."""

    out: Path
    made_by: Provenance
    subjects: dict[str, Sequence]  # by name
    methods: list[MethodSpec]
    size: int = 128  # pixels
    jobs: int = 1
    device: str = "cpu"
    counts: tuple[int, ...] = ()  # of input views
    every: int = 4  # every N-th frame
    setup: str = "alternating"
    columns: int = 6  # frames to show
    runs: tuple[str, ...] = ()  # NAME=FOLDER
    window: int = 5  # reports that curves are averaged over


def scene_of(options: StudyOptions, seq: Sequence, chosen: list[int], method: MethodSpec):
    """The scene that a method makes of some views, without what the inference filters would never draw."""
    scene = reconstruct(load_views(seq, chosen, method.has_depth, options.size), method, options.device)
    return scene[scene.alive()]


def subjects(folders: list[Path], size: int) -> dict[str, Sequence]:
    """Every Sequence below the folders by name. Raises InputError where there is none, or one cannot be shrunk."""
    found = sorted({p for f in folders for p in sequences_in(f)})
    if not found:
        raise InputError(f"{folders[0]}: no Sequence in it; {protocol.RENDER}.")
    out = {n: open_sequence(f) for n, f in name_sequences(found).items()}
    for seq in out.values():
        if seq.width != seq.height or size < 1 or seq.width % size:
            raise InputError(f"{seq.root}: {seq.width}x{seq.height} pixels cannot be shrunk to {size}; choose --size.")
    return out


def scored(
    options: StudyOptions, study: str, conditions: Indices, inputs: Callable, targets: Callable, step: int = 1
) -> dict:
    """Every method on every object in every condition -> {(condition, label): [scores per object]}.
    inputs(seq, condition) and targets(seq, condition) give indices of views. step: the inputs are of every step-th
    frame."""

    def parts(seq: Sequence, c) -> list[tuple]:
        return [(inputs(seq, c), targets(seq, c))]

    return scored_parts(options, study, conditions, parts, step=step)


def scored_parts(options: StudyOptions, study: str, conditions: Indices, parts: Callable, **how) -> dict:
    """The same where parts(seq, condition) gives [(inputs, targets)], each reconstructed alone, whose scores are
    joined. how: `still` or `step` of a Run."""
    labels: list[tuple] = []
    runs = []
    for name, seq in options.subjects.items():
        for c in conditions:
            for chosen, held_out in parts(seq, c):  # bad input shows at once
                for m in options.methods:
                    labels.append((c, m.label, name))
                    runs.append(
                        Run(name, seq.folder, m, tuple(chosen), tuple(held_out), options.size, {"study": study}, **how)
                    )
    rows = run_all(runs, Cache(options.out), Conditions(jobs=options.jobs, device=options.device), study)
    joined: dict[tuple, dict[str, list]] = {}
    for at, row in zip(labels, rows, strict=True):
        frames = joined.setdefault(at, {k: [] for k in METRICS})
        for k in METRICS:
            frames[k] += row["frames"][k]
    out: dict = {}
    for (c, label, _), frames in joined.items():
        out.setdefault((c, label), []).append(frames)
    return out


def paper_views(seq: Sequence, _=None) -> list[int]:
    """What the paper scores: the four canonical views and a random one at every frame."""
    return protocol.targets(seq)


def novel_views(seq: Sequence, _=None) -> list[int]:
    """One novel random view at every frame."""
    return protocol.held_out(seq)


def per_object(rows: list[dict], metric: str) -> np.ndarray:
    """(objects,) means over the views that have a figure; NaN where none has."""
    values = [[x for x in r[metric] if x is not None] for r in rows]
    return np.array([np.mean(v) if v else np.nan for v in values])


def cells(rows: list[dict]) -> list[str]:
    """Mean over objects ± standard error of each metric; – where there is none."""
    out = []
    for k, m in METRICS.items():
        x = per_object(rows, k)
        error = f" ± {x.std(ddof=1) / len(x) ** 0.5:.{m.digits}f}" if len(x) > 1 else ""
        out.append("–" if np.isnan(x).any() else f"{x.mean():.{m.digits}f}{error}")
    return out


def printed(psnr: float, lpips: float, similarity: float) -> list[str]:
    """What the paper prints, in the columns of METRICS."""
    known = {"psnr": psnr, "lpips": lpips, "ssim": similarity}
    return [f"{known[k]:.{m.digits}f}" if k in known else "" for k, m in METRICS.items()]


def about(options: StudyOptions, what: str) -> str:
    names = list(options.subjects)
    return (
        f"{what} Mean ± standard error over {len(names)} objects ({', '.join(names)}), {options.size}², over white; "
        "fg: over the pixels that show the object."
    )


TITLES = [m.axis for m in METRICS.values()]
PAPERS = "Rows and columns marked as the paper's are what it prints: its data, its training, 256² unless said."
