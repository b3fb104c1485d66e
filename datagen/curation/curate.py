# SPDX-License-Identifier: GPL-3.0-or-later
"""`timesplat curate`: measures the Sequences below a folder, decides, and writes the table and the page."""

from __future__ import annotations

import argparse
import os
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path

from ..errors import InputError
from ..readers import sequences_in
from ..sequence import read_sequence
from .decisions import CURATION, OUT, SETS, Bounds, Decision, decide, read_decisions, write_decisions
from .duplicates import duplicates, small_pictures
from .measures import measure
from .page import advice, write_report

PAGE = "curation.html"


def curate(
    folder: Path,
    bounds: Bounds | None = None,
    *,
    jobs: int = 1,
    report: Callable[[str], None] = print,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Decision]:
    """Writes `curation.csv` and `curation.html` into the folder, and returns the rows. What an earlier table measured
    of Sequences that have not changed is kept, and its column `override` always. `report` gets a sentence for each
    Sequence that cannot be read, which gets no row, `progress` those done and all. Raises InputError where there is
    none, and for a table that is damaged."""
    folder, bounds = Path(folder), bounds or Bounds()
    before = {d.sequence: d for d in read_decisions(folder / CURATION)}
    found = [f for f in sequences_in(folder) if (f / "transforms.json").is_file()]
    if not found:
        raise InputError(f"{folder}: no Sequence in it; render some with `timesplat render`.")

    def look(path: Path) -> Decision | InputError:
        try:
            return _measured(folder, path, before)
        except InputError as e:
            return e

    measured = []
    with ThreadPoolExecutor(max(jobs, 1)) as pool:
        for i, row in enumerate(pool.map(look, found)):
            progress(i, len(found))
            if isinstance(row, InputError):
                report(str(row))
            else:
                measured.append(row)
    if not measured:
        raise InputError(f"{folder}: none of its {len(found)} Sequences can be read; render them again.")
    fit = [d for d in decide(measured, bounds, {}) if d.final != OUT]
    twins = duplicates({d.sequence: d.hash for d in fit}, small_pictures(folder))
    decisions = decide(measured, bounds, twins)
    write_decisions(folder / CURATION, decisions)
    write_report(folder / PAGE, folder.resolve(), decisions, bounds)
    progress(len(found), len(found))
    return decisions


def _measured(folder: Path, path: Path, before: dict[str, Decision]) -> Decision:
    """The row of a Sequence, nothing decided yet."""
    name, stamp = path.relative_to(folder).as_posix(), str((path / "transforms.json").stat().st_mtime_ns)
    known = before.get(name)
    if known and known.stamp == stamp:
        return known
    seq = read_sequence(path)
    values = {k: float(f"{v:.4g}") if isinstance(v, float) else v for k, v in asdict(measure(seq)).items()}
    licence, author = (str(seq.provenance.get(key, "")) for key in ("licence", "author"))
    hand = known.override if known else ""
    more = {"licence": licence, "author": author, "stamp": stamp}
    return Decision(sequence=name, set="", override=hand, reason="", **more, **values)


# ---------------------------------------------------------------- the command line


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `timesplat curate`."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    parser.add_argument("folder", type=Path, help="of Sequences at any depth, as `timesplat render` writes them")
    for name, text in (
        ("still", "below it nothing moves"),
        ("sufficient", "from here on a clip moves enough for HQ4D"),
        ("aggressive", "from here on too much"),
    ):
        default = getattr(Bounds(), name)
        text = f"the measure of motion: {text} (%(default)s)"
        parser.add_argument(f"--{name}", type=float, default=default, metavar="M", help=text)
    parser.add_argument("--jobs", type=int, default=cores, metavar="N", help="Sequences at a time (%(default)s)")


def run(args: argparse.Namespace) -> int:
    """`timesplat curate`: 0, or 2 where a Sequence cannot be read. InputError where there is nothing to curate."""
    from tqdm import tqdm

    bounds, told = Bounds(args.still, args.sufficient, args.aggressive), []
    with tqdm(total=0, unit="sequence", delay=2, leave=False, disable=None) as bar:

        def progress(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        def report(sentence: str) -> None:
            told.append(sentence)
            bar.write(sentence)

        decisions = curate(args.folder, bounds, jobs=args.jobs, report=report, progress=progress)
    count = Counter(d.final for d in decisions)
    print(", ".join(f"{count[name]} {name}" for name in (*SETS, OUT)))
    for d in decisions:
        if d.final == OUT:
            print(f"  {d.sequence}: {'by hand' if d.override else d.reason}")
    print(advice(decisions, bounds))
    print(f"{args.folder / CURATION} has each decision, and a column to override it; {args.folder / PAGE} shows them")
    return 2 if told else 0
