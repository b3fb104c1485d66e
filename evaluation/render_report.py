# SPDX-License-Identifier: GPL-3.0-or-later
"""What a run of the renderer made, what failed, what it cost, and what more of it would cost: `timesplat report`.

Everything is read from the run's folder (`datagen.render_index`), so that a run which goes on, was killed, or was many
machines' is told of all the same. Sizes are those of a sample of its Sequences, evenly drawn.
"""

from __future__ import annotations

import argparse
import os
import shutil
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..datagen.errors import InputError
from ..datagen.render_index import RENDERED, Row, join_index
from ..datagen.sequence import read_sequence
from ..datagen.shards import PackSettings, bytes_in_shard
from ..datagen.whole_folders import write_whole
from .provenance import Provenance, machine, usable_cores

MEASURED, PACKED = 64, 12  # Sequences that are looked at, and packed, to know their sizes
DEAREST = 5  # assets that are named
KINDS = {"images": "pictures", "passes": "passes", "tracks.npz": "tracks"}  # of files in a Sequence; the rest: "other"


@dataclass(frozen=True)
class Cost:
    """What the assets of a run cost, each on average, failed ones included."""

    assets: int
    seconds: float  # of the processor, or by the clock where it was not measured
    pictures: float
    files: float
    on_disk: dict[str, float]  # bytes by kind, as many as the file system takes for them
    packed: dict[str, float]  # bytes by ending, in shards
    download: float | None  # bytes of the file itself; None = not known


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `timesplat report`."""
    parser.add_argument("folder", type=Path, help="that `timesplat render --out` wrote, or is writing")
    parser.add_argument("--project", type=int, metavar="N", help="what N such assets would take: core-hours, "
                        "terabytes, files, and what runs out first")  # fmt: skip
    parser.add_argument("--assets", type=Path, metavar="ROOT", help="folder of the files that were rendered; the "
                        "projection has their download too")  # fmt: skip
    parser.add_argument("--mbit", type=float, default=1000.0, metavar="M", help="megabits a second of that download "
                        "(%(default)g)")  # fmt: skip
    parser.add_argument("--out", type=Path, metavar="FILE.md", help="also write it there")


def run(args: argparse.Namespace) -> int:
    """`timesplat report`: 0. InputError where nothing was rendered."""
    from tqdm import tqdm

    for name in ("project", "mbit"):
        if getattr(args, name) is not None and not getattr(args, name) > 0:
            raise InputError(f"--{name} {getattr(args, name)}: too small; give a number above 0.")
    with tqdm(unit="asset", delay=2, leave=False, disable=None) as bar:
        found = _found(args.folder, lambda count: bar.update(count - bar.n))
    with tqdm(total=1.0, bar_format="{l_bar}{bar}", delay=2, leave=False, disable=None, desc="sizes") as bar:
        cost = measure(*found, args.assets, lambda fraction: bar.update(fraction - bar.n))
    text = page(*found, cost, Provenance.of(args.command), args.project, args.mbit)
    print(text, end="")
    if args.out:
        write_whole(args.out, text.encode())
    return 0


def _found(folder: Path, progress: Callable[[int], None]) -> tuple[Path, list[Row]]:
    """The folder that holds the run's Sequences, and its rows. InputError where there are none."""
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder; give the one that `timesplat render --out` wrote.")
    hidden = folder / ".sequences"  # of `render --layout`
    folder = hidden if hidden.is_dir() else folder
    rows = join_index(folder, progress)
    if not rows:
        raise InputError(
            f"{folder}: nothing was rendered into it; give the folder that `timesplat render --out` wrote."
        )
    return folder, rows


# ---------------------------------------------------------------- figures


def measure(
    folder: Path, rows: Sequence[Row], assets: Path | None = None, progress: Callable[[float], None] = lambda x: None
) -> Cost:
    """Of a run in `folder`. assets: the root of its files. progress: 0..1."""
    named = {row.name for row in rows}
    folders = [folder / row.sequence for row in rows if row.status == RENDERED]
    timed = timed_rows(rows)
    on_disk: Counter[str] = Counter()
    packed: Counter[str] = Counter()
    files, sample, small = 0, evenly(folders, MEASURED), evenly(folders, PACKED)
    for i, one in enumerate(sample):
        for path in (p for p in one.rglob("*") if p.is_file()):
            kind = KINDS.get(path.relative_to(one).parts[0], "other")
            on_disk[kind] += _taken(path)
            files += 1
        progress(0.3 * (i + 1) / len(sample))
    for i, one in enumerate(small):
        packed.update(bytes_in_shard(read_sequence(one), PackSettings()))
        progress(0.3 + 0.7 * (i + 1) / len(small))
    an_asset = len(folders) / len(named)  # Sequences
    sources = {row.source: assets / row.source for row in rows} if assets else {}
    sizes = [path.stat().st_size for path in sources.values() if path.is_file()]
    return Cost(
        assets=len(named),
        seconds=sum(spent for _, spent in timed) / max(len({row.name for row, _ in timed}), 1),
        pictures=sum(row.pictures for row in rows) / len(named),
        files=an_asset * files / max(len(sample), 1),
        on_disk={kind: an_asset * size / len(sample) for kind, size in on_disk.items()},
        packed={end: an_asset * size / len(small) for end, size in packed.items()},
        download=float(np.mean(sizes)) if sizes else None,
    )


def timed_rows(rows: Sequence[Row]) -> list[tuple[Row, float]]:
    """The rows whose processor seconds are known, with them; where none's are, all, with those by the clock."""
    known = [(row, row.cpu_seconds) for row in rows if row.cpu_seconds > 0]
    return known or [(row, row.seconds) for row in rows]


def evenly(items: Sequence, count: int) -> list:
    """At most so many of them, from the first to the last."""
    if len(items) <= count:
        return list(items)
    return [items[i] for i in np.linspace(0, len(items) - 1, count).round().astype(int)]


def _taken(path: Path) -> int:
    """Bytes that a file takes of its disk."""
    about = path.stat()
    return getattr(about, "st_blocks", 0) * 512 or about.st_size


def reason(row: Row) -> str:
    """Why an asset failed, without its name and the remedy."""
    return row.sentence.partition(": ")[2].partition(";")[0] or row.sentence


# ---------------------------------------------------------------- the page


def page(folder: Path, rows: Sequence[Row], cost: Cost, made_by: Provenance, project: int | None, mbit: float) -> str:
    """Markdown."""
    lines = ["# What was rendered, and what it costs", "", f"`{made_by.command}`", "", str(made_by), ""]
    lines += [*_what(rows, cost), *_failures(rows), *_dearest(rows)]
    if project:
        lines += _projection(folder, cost, project, mbit)
    lines += ["", f"{machine()['cpu']}, {usable_cores()} cores. Sizes of Sequences are those of {MEASURED} of them at "
              f"most, evenly drawn, as their disk has them; packed, of {PACKED}."]  # fmt: skip
    return "\n".join(lines) + "\n"


def _what(rows: Sequence[Row], cost: Cost) -> list[str]:
    rendered = [row for row in rows if row.status == RENDERED]
    failed = {row.name for row in rows if row.status != RENDERED}
    timed = timed_rows(rows)
    by_asset: dict[str, float] = defaultdict(float)
    for row, spent in timed:
        by_asset[row.name] += spent
    unknown = len({row.name for row in rows} - by_asset.keys())
    clock = not any(row.cpu_seconds for row in rows)
    what = "seconds by the clock" if clock else "processor seconds"
    spent = sum(by_asset.values())
    median, most = np.percentile(list(by_asset.values()), [50, 95])
    pictures = sum(row.pictures for row, _ in timed)
    loose, packed = sum(cost.on_disk.values()), sum(cost.packed.values())
    table = [
        ("assets", f"{cost.assets:,}: {cost.assets - len(failed):,} rendered, {len(failed):,} failed"),
        ("Sequences", f"{len(rendered):,}"),
        ("pictures", f"{sum(row.pictures for row in rows):,}"),
        (f"{what}, an asset", f"{cost.seconds:.1f} on average, {median:.1f} for half of them, {most:.1f} for 95%"),
        (f"pictures a {'second' if clock else 'processor second'}", f"{pictures / max(spent, 1e-9):.2f}"),
        ("an asset on disk", f"{loose / 1e6:.2f} MB ({_kinds(cost.on_disk, _megabytes)}) in {cost.files:.0f} files"),
        ("packed", f"{packed / 1e6:.2f} MB with passes, {_without_passes(cost) / 1e6:.2f} MB without"),
    ]
    lines = ["| | |", "|---|---|", *(f"| {name} | {text} |" for name, text in table)]
    if clock:
        lines += ["", "An earlier version rendered this, which did not measure processor seconds: those by the clock "
                  "stand in for them, and are as much longer as the machine was busy."]  # fmt: skip
    elif unknown:
        lines += ["", f"Of {unknown:,} assets the processor seconds are not known; they are left out of that mean."]
    return lines


def _kinds(sizes: dict[str, float], text: Callable[[float], str]) -> str:
    order = sorted(sizes.items(), key=lambda item: -item[1])
    return ", ".join(f"{kind} {text(size)}" for kind, size in order)


def _megabytes(size: float) -> str:
    return f"{size / 1e6:.2f}"


def _without_passes(cost: Cost) -> float:
    return sum(size for end, size in cost.packed.items() if end != "exr")


def _failures(rows: Sequence[Row]) -> list[str]:
    groups: dict[tuple[str, str], list[Row]] = defaultdict(list)
    for row in rows:
        if row.status != RENDERED:
            groups[row.status, reason(row)].append(row)
    if not groups:
        return []
    lines = ["", "| failed | why | assets | for example |", "|---|---|---|---|"]
    for (status, why), found in sorted(groups.items(), key=lambda item: (-len(item[1]), item[0])):
        lines.append(f"| {status} | {why.replace('|', '/')} | {len(found):,} | {found[0].source} |")
    return lines


def _dearest(rows: Sequence[Row]) -> list[str]:
    spent: dict[str, float] = defaultdict(float)
    for row, seconds in timed_rows(rows):
        spent[row.name] += seconds
    order = sorted(spent.items(), key=lambda item: -item[1])
    named = ", ".join(f"{name} ({seconds:.0f} s)" for name, seconds in order[:DEAREST])
    tenth = sum(seconds for _, seconds in order[: max(len(order) // 10, 1)])
    share = tenth / max(sum(spent.values()), 1e-9)
    return ["", f"The dearest tenth takes {share:.0%} of the time; first of all {named}."]


# ---------------------------------------------------------------- what more would take


def _projection(folder: Path, cost: Cost, count: int, mbit: float) -> list[str]:
    loose, packed, bare = sum(cost.on_disk.values()), sum(cost.packed.values()), _without_passes(cost)
    hours = count * cost.seconds / 3600
    shards = -(-count // PackSettings.clips)
    kinds = _kinds(cost.on_disk, lambda size: _terabytes(count * size))
    table = [
        ("core-hours", f"{hours:,.0f}: {hours / 24 / 64:,.1f} days of 64 cores"),
        ("pictures", f"{count * cost.pictures:,.0f}"),
        ("as Sequences", f"{_terabytes(count * loose)} ({kinds}) in "
         f"{count * cost.files:,.0f} files"),
        ("packed with passes", f"{_terabytes(count * packed)} in {shards:,} shards of {PackSettings.clips} clips"),
        ("packed without", _terabytes(count * bare)),
    ]  # fmt: skip
    if cost.download is not None:
        hours_of_link = count * cost.download * 8 / (mbit * 1e6) / 3600
        size = _terabytes(count * cost.download)
        each = f"{cost.download / 1e6:.2f} MB a file"
        table.append(("download", f"{size}, {each}: {hours_of_link:,.1f} hours at {mbit:g} Mbit/s"))
    lines = ["", f"## {count:,} such assets", "", "| | |", "|---|---|"]
    lines += [f"| {name} | {text} |" for name, text in table]
    return [*lines, "", *_first(folder, cost, count, mbit)]


def _first(folder: Path, cost: Cost, count: int, mbit: float) -> list[str]:
    """What runs out first, on this disk and in general."""
    loose = sum(cost.on_disk.values())
    room = {"the disk": shutil.disk_usage(folder).free / max(loose, 1)}
    free = f"{shutil.disk_usage(folder).free / 1e9:,.0f} GB"
    if hasattr(os, "statvfs") and (inodes := os.statvfs(folder).f_favail):
        room["the number of files"] = inodes / max(cost.files, 1)
        free += f" and {inodes / 1e6:,.1f} million files"
    first = min(room, key=lambda name: room[name])
    ends = ", ".join(f"{name} after {n:,.0f} assets" for name, n in sorted(room.items(), key=lambda x: x[1]))
    if room[first] < count:
        parts = -(-count // max(int(room[first]), 1))
        told = [f"On this disk, with {free} free, {first} runs out first ({ends}): render in {parts:,} parts "
                f"(`--shard I/{parts}`) and pack each."]  # fmt: skip
    else:
        told = [f"This disk, with {free} free, holds them all ({ends})."]
    days = count * cost.seconds / 86400 / usable_cores()
    told.append(f"By time the processor is first here: {days:,.0f} days of these {usable_cores()} cores.")
    if cost.download is not None:
        even = cost.seconds / (cost.download * 8 / (mbit * 1e6))
        told[-1] += f" The download at {mbit:g} Mbit/s takes as long as the rendering on {even:,.0f} cores."
    written = loose / cost.seconds if cost.seconds else 0
    told[-1] += f" A core writes {written / 1e6:.2f} MB/s, {cost.files / max(cost.seconds, 1e-9):,.0f} files a second."
    return told


def _terabytes(size: float) -> str:
    return f"{size / 1e12:,.2f} TB" if size >= 1e11 else f"{size / 1e9:,.2f} GB"
