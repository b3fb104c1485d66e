# SPDX-License-Identifier: GPL-3.0-or-later
"""Every method on every condition: stress.csv, a line a cell, written as they are made, so that a run that was stopped
goes on; and a picture of each cell's worst view beside the truth."""

from __future__ import annotations

import csv
import hashlib
import io
import multiprocessing
import os
import signal
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from ...datagen.sequence import InputError
from ...datagen.zoo.trials import VERSION
from ...model.methods import ReconstructOptions
from ...model.parallel import work_clock
from ...model.reconstruct import reconstruct_views
from ..loading import without_depth
from ..method_spec import MethodSpec
from ..pictures import as_bytes
from ..scoring import draw
from .measures import MEASURES, measured
from .scenes import Scene, load_scene, trial_folder
from .sweeps import Condition

COLUMNS = ["key", "method", *(f.name for f in fields(Condition)), *MEASURES, "failed"]


def key_of(condition: Condition, method: str, samples: int) -> str:
    """Of a cell; `method` is a fingerprint. By all that has a say in it but the code of methods."""
    return hashlib.sha256(f"{VERSION} {samples} {condition.key} {method}".encode()).hexdigest()[:16]


@dataclass(frozen=True)
class Cell:
    """One reconstruction that is scored."""

    condition: Condition
    method: MethodSpec
    samples: int  # a pixel, of the trial

    @property
    def key(self) -> str:
        return key_of(self.condition, self.method.fingerprint, self.samples)


class Figures:
    """stress.csv in a folder."""

    def __init__(self, out: Path):
        self.out, self.path = out, out / "stress.csv"

    def rows(self) -> dict[str, dict[str, str]]:
        """{key: row}; a line that was cut off is left out."""
        if not self.path.exists():
            return {}
        text = self.path.read_text()
        whole = text[: text.rfind("\n") + 1]
        reader = csv.DictReader(io.StringIO(whole))
        if reader.fieldnames != COLUMNS:
            raise InputError(f"{self.path}: it is of another version; give another --out.")
        return {row["key"]: row for row in reader if None not in row.values()}

    def add(self, row: dict) -> None:
        line = io.StringIO()
        writer = csv.DictWriter(line, COLUMNS, lineterminator="\n")
        if not self.path.exists():
            self.out.mkdir(parents=True, exist_ok=True)
            writer.writeheader()
        else:
            data = self.path.read_bytes()
            if not data.endswith(b"\n"):  # of a run that was cut off
                self.path.write_bytes(data[: data.rfind(b"\n") + 1])
        writer.writerow(row)
        with open(self.path, "a") as file:
            file.write(line.getvalue())

    def picture(self, key: str) -> Path:
        """The worst view of a cell: truth, and what was made of it, side by side."""
        return self.out / "pictures" / f"{key}.png"


def reconstruct(views, cell: Cell):
    """The scene that a method makes of the views of a cell, without what is never drawn."""
    m = cell.method
    options = ReconstructOptions(
        checkpoint=m.checkpoint, seconds=m.seconds or 10.0, refine=m.refine or 0.0, quality=m.quality, steps=m.steps,
        budget=m.budget, dense=m.dense, seed=cell.condition.seed,
    )  # fmt: skip
    with torch.no_grad():
        scene = reconstruct_views(views if m.has_depth else without_depth(views), m.method, options)
    return scene[scene.alive()]


def row_of(cell: Cell, scene: Scene, out: Path) -> dict:
    """The line of a cell; where the method refuses or fails, with the reason in place of figures."""
    told = {"key": cell.key, "method": cell.method.label} | vars(cell.condition)
    start = work_clock()
    try:
        made = reconstruct(scene.inputs, cell)
    except Exception as e:  # any: that it fails is what is measured
        return told | {"failed": f"{type(e).__name__}: {e}".splitlines()[0][:200]}
    taken = work_clock() - start
    moments, watch = (draw(made, t.views) for t in (scene.moments, scene.watch))
    found, worst = measured(moments, watch, scene)
    keep_picture(out, cell.key, scene.moments.picture[worst], moments[0][worst])
    return told | rounded(found | {"gaussians": len(made), "seconds": taken}) | {"failed": ""}


def rounded(figures: dict) -> dict:
    """Four decimals; a figure that is not finite says so."""
    return {k: round(float(v), 4) for k, v in figures.items()}


def keep_picture(out: Path, key: str, truth: Tensor, made: Tensor) -> None:
    """Writes the picture of a cell: truth and made (H,W,3) side by side."""
    from PIL import Image

    path = Figures(out).picture(key)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(as_bytes(torch.cat([truth, made], 1))).save(path)


# ---------------------------------------------------------------- many of them


def run(out: Path, cells: list[Cell], jobs: int) -> dict[str, dict]:
    """{key: row} of the cells; those that stress.csv has are taken from there, the others made, `jobs` at a time."""
    figures = Figures(out)
    known = figures.rows()
    todo: dict[Condition, list[Cell]] = {}
    for cell in {c.key: c for c in cells}.values():
        if cell.key not in known:
            todo.setdefault(cell.condition, []).append(cell)
    with tqdm(total=len(cells), desc="stress", unit="cell", disable=None) as bar:
        bar.update(len(cells) - sum(map(len, todo.values())))
        for row in _map(out, list(todo.values()), jobs):
            figures.add(row)
            known[row["key"]] = row
            bar.set_postfix_str(row["method"])
            bar.update()
    return {c.key: known[c.key] for c in cells}


def _map(out: Path, groups: list[list[Cell]], jobs: int) -> Iterator[dict]:
    """The rows of groups of cells of one condition each: in this process, or in several of one thread each. What is
    measured with several threads is measured here, after the others."""
    own = [g for g in groups if g[0].condition.threads > 1 or jobs <= 1]
    shared = [g for g in groups if g not in own]
    if shared:
        os.environ["OMP_NUM_THREADS"] = "1"  # read when the children load their libraries
        with multiprocessing.get_context("spawn").Pool(min(jobs, len(shared)), _ignore_stops) as pool:
            for rows in pool.imap_unordered(_rows, [(out, g) for g in shared]):
                yield from rows
    for group in own:
        yield from _rows((out, group))


def _ignore_stops() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent tells when to stop


def _rows(job: tuple[Path, list[Cell]]) -> list[dict]:
    out, cells = job
    condition = cells[0].condition
    before = torch.get_num_threads()
    torch.set_num_threads(condition.threads)
    try:
        scene = load_scene(trial_folder(out, condition, cells[0].samples), condition)
        return [row_of(cell, scene, out) for cell in cells]
    finally:
        torch.set_num_threads(before)


def number(row: dict, key: str) -> float:
    """A figure of a row; NaN where the method failed."""
    value = row.get(key, "")
    return float(value) if value not in ("", None) else float(np.nan)
