# SPDX-License-Identifier: GPL-3.0-or-later
"""Methods against one another, object by object: `python -m timesplat.evaluation.differences out/tables/rows.jsonl
guided guided+refine:10 guided+budget:10%` says, of the rows that `timesplat evaluate` wrote, how much each of the later
methods is above the first one on novel views (PSNR in dB: mean, standard error, the worst object), and with how many
of its Gaussians and seconds."""

from __future__ import annotations

import argparse
import json
import math
import statistics
import sys
from collections import defaultdict
from pathlib import Path

from ..datagen.sequence import InputError
from ..exit_codes import exit_code


def read(path: Path) -> dict[tuple, dict[str, dict]]:
    """{(size, setup, method): {object: row}}. Raises InputError where there is no such file."""
    if not path.is_file():
        raise InputError(f"{path}: no such file; `timesplat evaluate --out DIR` writes DIR/rows.jsonl.")
    found: dict[tuple, dict[str, dict]] = defaultdict(dict)
    for line in path.read_text().splitlines():
        if line.strip():
            row = json.loads(line)
            found[row["size"], row["setup"], row["method"]][row["object"]] = row
    return found


def compare(rows: dict, first: str, others: list[str]) -> list[str]:
    """Lines of a markdown table, one for each size, setup and other method with objects in common."""
    head = ["pixels", "setup", "method", "objects", "dB above", "s.e.", "worst", "at or above", "Gaussians", "seconds"]
    lines = [f"| {' | '.join(head)} |", "|" + " --- |" * len(head)]
    for size, setup, method in sorted(rows):
        here, base = rows[size, setup, method], rows.get((size, setup, first), {})
        names = sorted(set(here) & set(base))
        if method not in others or not names:
            continue

        def column(table: dict, key: str, names=names) -> list[float]:
            return [table[n][key] for n in names]

        pairs = zip(column(here, "novel_psnr"), column(base, "novel_psnr"), strict=True)
        gain = [a - b for a, b in pairs]
        error = statistics.stdev(gain) / math.sqrt(len(gain)) if len(gain) > 1 else 0.0
        count, seconds = (
            f"{statistics.mean(column(base, k)):.{d}f} → {statistics.mean(column(here, k)):.{d}f}"
            for k, d in (("gaussians_kept", 0), ("seconds", 1))
        )
        cells = [size, setup, method, len(gain), f"{statistics.mean(gain):+.2f}", f"{error:.2f}", f"{min(gain):+.2f}"]
        cells += [f"{sum(x >= 0 for x in gain)}", count, seconds]
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return lines


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rows", type=Path, help="rows.jsonl of `timesplat evaluate`")
    parser.add_argument("first", help="the method that the others are held against")
    parser.add_argument("others", nargs="+")
    args = parser.parse_args(argv)
    return exit_code("differences", lambda: print("\n".join(compare(read(args.rows), args.first, args.others))))


if __name__ == "__main__":
    sys.exit(main())
