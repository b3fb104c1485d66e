# SPDX-License-Identifier: GPL-3.0-or-later
"""The three sets that training draws from, as the paper's data has them (appendix, "Dataset Curation"), what is thrown
out and why, and `curation.csv`, in which a person overrides any of it.

`hq4d` moves much, but not wildly; `4d` is all else that moves; `3d` are still objects, displaced or not.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

from ..errors import InputError
from ..whole_folders import write_whole
from .measures import Measures

SETS = ("hq4d", "4d", "3d")
OUT = "out"
CURATION = "curation.csv"


@dataclass(frozen=True)
class Bounds:
    """What decides. `motion` is in units of `measures.motion_of`. (The paper keeps 3,000 of 32,000 animated objects,
    "sufficient but not overly aggressive"; of 135 of ours, animated files and zoo, these keep 59.) InputError for
    bounds that are not in order."""

    still: float = 0.01  # motion: nothing moves below
    sufficient: float = 0.25  # motion: hq4d from here …
    aggressive: float = 0.45  # … to below this
    border: float = 0.02  # a share of the border that noise does not cover
    empty: float = 0.25  # of the moments: what appears in the course of a clip is none the worse
    small: float = 0.15  # of the picture's side
    growth: float = 3.0
    variety: float = 0.01
    magenta: float = 0.02

    def __post_init__(self) -> None:
        if not 0 <= self.still <= self.sufficient <= self.aggressive:
            order = f"--still {self.still:g}, --sufficient {self.sufficient:g}, --aggressive {self.aggressive:g}"
            raise InputError(f"{order}: not in order; each must be at least the one before, from 0.")


@dataclass(frozen=True)
class Decision:
    """A row of `curation.csv`. A person writes one of SETS or "out" into `override`, which counts in place of `set`."""

    sequence: str  # folder of the Sequence, below that of the table
    set: str  # one of SETS, or "out"
    override: str
    reason: str  # why it is out; of one that is in, what there is to be said
    motion: float
    moves: bool
    still: bool
    border: float
    empty: float
    size: float
    growth: float
    variety: float
    magenta: float
    licence: str
    author: str
    stamp: str  # of what was measured: a Sequence that has another is measured anew
    hash: str

    @property
    def final(self) -> str:
        """The set that counts."""
        return self.override or self.set


def set_of(motion: float, still: bool, bounds: Bounds = Bounds()) -> str:
    """By motion alone; one whose motion is not known (NaN) is of 4d."""
    if still or motion < bounds.still:
        return "3d"
    return "hq4d" if bounds.sufficient <= motion < bounds.aggressive else "4d"


def faults(m: Measures, bounds: Bounds) -> list[str]:
    """Why a Sequence is not to be trained on; none for most."""
    told = [
        (m.empty > bounds.empty, f"shows nothing at {m.empty:.0%} of the moments"),
        (m.border > bounds.border, f"leaves the frame: {m.border:.0%} of the border shows something"),
        (0 < m.size < bounds.small, f"bounds explode: what is shown has {m.size:.0%} of the picture's side"),
        (m.growth > bounds.growth, f"bounds explode: it grows {m.growth:.1f} times"),
        (m.magenta > bounds.magenta, f"magenta: {m.magenta:.0%} have the colour of missing textures"),
        (m.empty < 1 and m.variety < bounds.variety, "single colour"),
        (m.moves and m.motion < bounds.still, "still, where motion is promised"),
    ]
    return [text for wrong, text in told if wrong]


def decide(decisions: Iterable[Decision], bounds: Bounds, twins: dict[str, str]) -> list[Decision]:
    """The same with `set` and `reason` by the bounds and by `twins`: a duplicate -> what it is a duplicate of."""
    found = []
    for d in decisions:
        why = faults(measures_of(d), bounds)
        if twin := twins.get(d.sequence):
            why.append(f"duplicate of {twin}")
        note = "" if not math.isnan(d.motion) or d.still else "no camera stands still: its motion is not known"
        chosen = OUT if why else set_of(d.motion, d.still, bounds)
        found.append(replace(d, set=chosen, reason="; ".join(why) or note))
    return found


def measures_of(d: Decision) -> Measures:
    """What a row says was measured."""
    return Measures(**{f.name: getattr(d, f.name) for f in fields(Measures)})


# ---------------------------------------------------------------- the table


def write_decisions(path: Path, decisions: Iterable[Decision]) -> None:
    """The table, sorted, whole or as it was."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, [f.name for f in fields(Decision)], lineterminator="\n")
    writer.writeheader()
    for d in sorted(decisions, key=lambda d: d.sequence):
        writer.writerow({k: f"{v:.4g}" if isinstance(v, float) else v for k, v in asdict(d).items()})
    write_whole(path, text.getvalue().encode("utf-8", "surrogateescape"))


def read_decisions(path: Path) -> list[Decision]:
    """What a table says, perhaps after a person saved it from a spreadsheet; none where there is no file. Raises
    InputError naming the line."""
    try:
        with open(path, newline="", encoding="utf-8-sig", errors="surrogateescape") as f:
            reader, found = csv.DictReader(f), []
            for row in reader:
                try:
                    found.append(_decision(row))
                except (KeyError, ValueError, TypeError, AttributeError) as e:
                    what = f"{e}" if isinstance(e, InputError) else "it is damaged"
                    remedy = f"write {', '.join((*SETS, OUT))} or nothing into override, or remove the file"
                    raise InputError(f"{path}, line {reader.line_num}: {what}; {remedy}.") from None
            return found
    except FileNotFoundError:
        return []
    except (OSError, csv.Error) as e:
        raise InputError(f"{path}: it cannot be read ({e}); remove it, and curate makes it anew.") from None


def _decision(row: dict[str, str]) -> Decision:
    values: dict = {f.name: row[f.name].strip() for f in fields(Decision)}
    for f in fields(Decision):
        if f.type == "float":
            values[f.name] = float(values[f.name])
        elif f.type == "bool":
            values[f.name] = {"true": True, "false": False}[values[f.name].lower()]
    values["override"] = values["override"].lower()
    if values["override"] not in ("", *SETS, OUT):
        raise InputError(f"{values['override']} is no set")
    return Decision(**values)


def decided(folders: Iterable[Path]) -> dict[Path, str]:
    """The set ("out" included) of each of the Sequence folders that the nearest `curation.csv` at or above it names.
    Raises InputError for a table that is damaged."""
    tables: dict[Path, dict[str, str] | None] = {}
    found = {}
    for folder in folders:
        whole = Path(folder).resolve()
        for above in (whole, *whole.parents):
            if above not in tables:
                path = above / CURATION
                rows = read_decisions(path) if path.is_file() else None
                tables[above] = None if rows is None else {d.sequence: d.final for d in rows}
            table = tables[above]
            if table is not None:
                if name := table.get(whole.relative_to(above).as_posix()):
                    found[folder] = name
                break
    return found
