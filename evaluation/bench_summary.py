# SPDX-License-Identifier: GPL-3.0-or-later
"""Rows of `timesplat bench` to bench.csv and back, to means over objects, and to what no other method beats (Pareto
frontiers)."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..datagen.sequence import InputError
from ..datagen.whole_folders import write_whole
from .method_spec import MethodSpec, parse_spec
from .metrics import METRICS
from .scoring import COSTS

FIGURES = ("seconds", *METRICS, "gaussians", *COSTS)
COLUMNS = ("object", "way", "setup", "views", "size", *FIGURES)  # way: the label of a MethodSpec


def bench_row(row: dict) -> dict:
    """COLUMNS of a row of the runner. None where a figure cannot be: a scene that is no 4D Gaussians has no files, for
    example. Gaussians are those that the filters keep."""
    row = row | {"way": row["method"], "gaussians": row["gaussians_kept"]}
    return {k: row[k] for k in COLUMNS}


def write_csv(path: Path, rows: list[dict], command: str, facts: dict) -> None:
    """COLUMNS of rows, after two comments: the command, and facts (machine, date, …) as JSON. Whole or not at all."""
    text = io.StringIO()
    text.write(f"# {command}\n# {json.dumps(facts)}\n")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for r in rows:
        cells = (r.get(k) for k in COLUMNS)
        writer.writerow(["" if c is None else f"{c:.7g}" if isinstance(c, float) else c for c in cells])
    write_whole(path, text.getvalue().encode())


def read_csv(path: Path) -> tuple[list[dict], str, dict]:
    """-> rows, command and facts of a `write_csv`. Raises InputError for what is none."""
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; name the bench.csv that `timesplat bench` wrote.")
    try:
        first, second, *lines = path.read_text().splitlines()
        facts = json.loads(second.removeprefix("# "))
        rows = []
        for r in csv.DictReader(lines):
            if None in r.values():
                raise ValueError("cut off")
            r |= {k: float(r[k]) if r.get(k) else None for k in FIGURES}  # a metric may be younger than the file
            rows.append({k: r[k] for k in COLUMNS} | {k: int(r[k]) for k in ("views", "size")})
        for r in rows:
            parse_spec(r["way"], seconds=10.0)
        if not (first.startswith("# ") and rows and {"centre", "notes", "jobs", "seconds_total"} <= set(facts)):
            raise ValueError
    except (ValueError, KeyError, TypeError):
        raise InputError(f"{path}: not a whole bench.csv; run `timesplat bench` again.") from None
    return rows, first.removeprefix("# "), facts


@dataclass
class Mean:
    """A method in a setup at a size, over objects."""

    method: MethodSpec
    setup: str
    views: int
    size: int
    count: int  # objects
    mean: dict[str, float | None]  # of FIGURES
    error: dict[str, float]  # standard errors over objects; 0 for one object
    gain: dict[str, float] = field(default_factory=dict)  # of metrics against the centre, same objects
    gain_error: dict[str, float] = field(default_factory=dict)  # standard errors of these paired differences

    def __getitem__(self, key: str) -> float:
        """The mean of a figure that there is."""
        value = self.mean[key]
        assert value is not None, f"{self.method.label} has no {key}"
        return value


def reference(method: MethodSpec) -> str:
    """The one at the centre that a method is compared with: they see the same."""
    return "guided" if method.has_depth else "rgb"


def summarise(rows: list[dict], centre: tuple[str, int]) -> list[Mean]:
    """Means of every Point that has as many objects as the one that has most; `centre` is a setup and a size."""
    groups: dict[tuple, dict[str, dict]] = {}
    for r in rows:
        groups.setdefault((r["way"], r["setup"], r["size"]), {})[r["object"]] = r
    most = max(map(len, groups.values()), default=0)
    found = []
    for (label, setup, size), objects in groups.items():
        if len(objects) < most:
            continue
        method = parse_spec(label, seconds=10.0)
        mean: dict[str, float | None] = {}
        error: dict[str, float] = {}
        for k in FIGURES:
            values = [r[k] for r in objects.values()]
            known = None not in values
            mean[k] = float(np.mean(values)) if known else None
            error[k] = standard_error(values) if known else 0.0
        m = Mean(method, setup, next(iter(objects.values()))["views"], size, len(objects), mean, error)
        other = groups.get((reference(method), *centre), {})
        for k in METRICS:
            pairs = [(r[k], other[n][k]) for n, r in objects.items() if n in other]
            differences = [a - b for a, b in pairs if a is not None and b is not None]
            if differences:
                m.gain[k], m.gain_error[k] = float(np.mean(differences)), standard_error(differences)
        found.append(m)
    return found


def standard_error(values: list[float]) -> float:
    return float(np.std(values, ddof=1)) / len(values) ** 0.5 if len(values) > 1 else 0.0


def frontier(cost: list[float], worth: list[float]) -> list[int]:
    """Indices of the points that no other one dominates (costs no more and is worth no less, and differs in one of
    them), by rising cost; of equal ones the first."""
    best, found = -float("inf"), []
    for i in sorted(range(len(cost)), key=lambda i: (cost[i], -worth[i], i)):
        if worth[i] > best:
            best = worth[i]
            found.append(i)
    return found
