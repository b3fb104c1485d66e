# SPDX-License-Identifier: GPL-3.0-or-later
"""`timesplat bench --scaling`: what methods make of more views, more pixels and more seconds, along three lines through
one centre. A good method never falls along a line: whoever gives more must not get less.

Views are those of the rig "mixed" (144 of 24 frames, all kinds of cameras), a part of them for fewer: evenly over the
frames, and all that are in a smaller part are in a larger one. Scored are its held-out views, at the size of the
inputs, and along the line of sizes at the largest as well, so that its points can be compared. Seconds are by the wall
on all cores, or of several jobs the processor's, on one each.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from ..datagen.sequence import InputError, Sequence
from . import protocol
from .method_spec import parse_spec
from .runner import Run

OBJECTS = ("zoo:1000013", "zoo:1000101", "zoo:1000102", "zoo:1000104")  # no checkpoint was trained on them
AXES = {"views": "input views", "size": "pixels a side", "seconds": "seconds"}
KEYS = {"views": "psnr", "size": "finer", "seconds": "psnr"}  # what is compared along a line
FALLS = 0.1  # dB by which a mean may fall along a line
COLUMNS = ("object", "way", "views", "size", "seconds", "psnr", "finer", "worst", "ssim", "lpips", "gaussians", "taken")


@dataclass(frozen=True)
class Lines:
    """Where the lines go, and what is measured along them."""

    views: tuple[int, ...] = (24, 48, 96, 144)
    size: tuple[int, ...] = (128, 256, 512)
    seconds: tuple[int, ...] = (3, 10, 30, 120)
    centre: tuple[int, int, int] = (96, 256, 30)
    ways: tuple[str, ...] = ("tracks", "flow", "deform", "4dgs")

    def points(self) -> list[tuple[int, int, int]]:
        """(views, size, seconds), the centre first and then by what they cost."""
        found = {self.centre}
        for i, name in enumerate(AXES):
            found |= {(*self.centre[:i], v, *self.centre[i + 1 :]) for v in getattr(self, name)}
        return sorted(found, key=lambda p: (p != self.centre, p[2], p[1], p[0]))


LINES = Lines()
QUICK = Lines((24, 96), (64, 128), (3, 10), (24, 128, 3))


def part_of(seq: Sequence, count: int) -> list[int]:
    """`count` of the views that are not held out, evenly over the frames: in rounds, each of which takes one of every
    frame, at random but always the same. Raises InputError where there are fewer."""
    rng, at = np.random.default_rng(0), dict[float, list[int]]()
    for i in seq.inputs():
        at.setdefault(seq.views[i].frame, []).append(i)
    order = [list(rng.permutation(at[f])) for f in sorted(at)]
    rounds = [[int(views[k]) for views in order if k < len(views)] for k in range(max(map(len, order)))]
    chosen: list[int] = []
    for one in rounds:
        left = min(count - len(chosen), len(one))
        chosen += [one[i * len(one) // left] for i in range(left)] if left else []
    if len(chosen) < count:
        raise InputError(f"{seq.root}: {len(chosen)} views that are not held out, and {count} are asked for; render it "
                         "with --rig mixed --targets 1.")  # fmt: skip
    return sorted(chosen)


def runs_of(sequences: dict[str, Sequence], lines: Lines) -> list[Run]:
    """Point by point, so that a run cut short has whole ones."""
    return [
        Run(name, seq.folder, parse_spec(f"{way}:{seconds}"), tuple(part_of(seq, views)),
            tuple(protocol.held_out(seq)), size, {"way": way, "asked": seconds},
            finer=max(lines.size) if (views, seconds) == (lines.centre[0], lines.centre[2]) else None)
        for views, size, seconds in lines.points()
        for name, seq in sequences.items()
        for way in lines.ways
    ]  # fmt: skip


def measure_scaling(options, started: float) -> list[str]:
    """`bench --scaling` with `BenchOptions`: table and chart; -> what could not be rendered. Raises InputError."""
    from ..datagen.render_job import RenderSettings
    from .cache import Cache
    from .provenance import Provenance
    from .runner import Conditions, run_all

    lines = QUICK if options.quick else LINES
    cache, settings = Cache(options.out), RenderSettings(rig="mixed", targets=1, size=max(lines.size))
    number = options.objects or (1 if options.quick else None)
    assets = options.assets or list(OBJECTS[:number])
    sequences, failures = cache.sequences(assets, settings, options.jobs, options.reading)
    sequences = dict(list(sequences.items())[:number])
    if not sequences:
        raise InputError(f"{assets[0]}: nothing to measure; none of the assets could be rendered.")
    deadline = started + options.limit if options.limit is not None else float("inf")
    how = Conditions(device=options.device, jobs=options.jobs, started=started, deadline=deadline)
    runs = runs_of(sequences, lines)
    rows = [row_of(r) for r in run_all(runs, cache, how, "measuring")]
    if not rows:
        raise InputError(f"{options.out}: nothing was measured in the time given; allow more.")
    made = Provenance.of(options.command, [r.method.weights for r in runs[: len(lines.ways)]])
    print(write(options.out, rows, lines, made, options.jobs))
    return failures


def row_of(row: dict) -> dict:
    """COLUMNS of a row of the runner."""
    told = {
        "seconds": row["asked"],
        "taken": row["seconds"],
        "gaussians": row["gaussians_kept"],
        "finer": row.get("psnr_finer"),
    }
    told["worst"] = min(f for f in row["frames"]["psnr"] if f is not None)
    return {k: (row | told).get(k) for k in COLUMNS}


# ---------------------------------------------------------------- table and chart


def means(rows: list[dict]) -> dict[tuple, dict[str, float]]:
    """{(way, views, size, seconds): means} of the points that all objects have."""
    groups: dict[tuple, list[dict]] = {}
    for r in rows:
        groups.setdefault((r["way"], r["views"], r["size"], r["seconds"]), []).append(r)
    most = max(map(len, groups.values()))
    keys = ("psnr", "finer", "worst", "ssim", "lpips", "gaussians", "taken")
    return {
        k: {c: float(np.mean([r[c] for r in g])) for c in keys if all(r[c] is not None for r in g)}
        for k, g in groups.items()
        if len(g) == most
    }


def falls(found: dict[tuple, dict[str, float]], lines: Lines) -> list[str]:
    """A sentence for each step along a line by which a mean falls by more than FALLS; along that of sizes, the mean at
    the largest."""
    said = []
    for way in lines.ways:
        for i, (name, axis) in enumerate(AXES.items()):
            line = [(v, found.get((way, *lines.centre[:i], v, *lines.centre[i + 1 :]))) for v in getattr(lines, name)]
            there = [(v, m[KEYS[name]]) for v, m in line if m and KEYS[name] in m]
            for (a, before), (b, after) in pairwise(there):
                if after < before - FALLS:
                    said.append(f"{way} falls from {before:.2f} to {after:.2f} dB between {a} and {b} {axis}")
    return said


def write(out: Path, rows: list[dict], lines: Lines, made_by, jobs: int = 1) -> str:
    """scaling.md and scaling.csv (means), scaling.png and .svg -> the page. made_by: a `Provenance`; jobs: how many
    fits there were at a time."""
    from .figures import write_table

    found, (views, size, seconds) = means(rows), lines.centre
    draw(out / "scaling", found, lines, made_by.command)
    head = (
        "way",
        "views",
        "pixels",
        "seconds",
        "PSNR",
        f"at {max(lines.size)}²",
        "worst view",
        "SSIM",
        "LPIPS",
        "Gaussians",
        "took, s",
    )
    cells = [
        (*point, f"{m['psnr']:.2f}", f"{m['finer']:.2f}" if "finer" in m else "", f"{m['worst']:.2f}",
         f"{m['ssim']:.3f}",
         f"{m['lpips']:.3f}" if "lpips" in m else "", f"{m['gaussians']:.0f}", f"{m['taken']:.1f}")
        for point, m in sorted(found.items(), key=lambda x: (lines.ways.index(x[0][0]), x[0][1:]))
    ]  # fmt: skip
    objects = sorted({r["object"] for r in rows})
    clock = f"of the processor, {jobs} fits at a time, one core each" if jobs > 1 else "by the wall, on all cores"
    notes = [
        f"Means over {', '.join(objects)}; held-out views, at the inputs' size (of other sizes, "
        f"at {max(lines.size)}² too). Three lines through {views} views, "
        f"{size} pixels and {seconds} s. Seconds {clock}; took: with all "
        "that comes before a fit.",
        *(falls(found, lines) or [f"No mean falls by more than {FALLS} dB with more views, pixels or seconds."]),
        "![PSNR along three lines](scaling.png)",
    ]
    return write_table(out / "scaling", "More views, pixels and seconds", head, cells, made_by, notes)


def draw(stem: Path, found: dict[tuple, dict[str, float]], lines: Lines, command: str) -> None:
    """A panel for each line, logarithmic, PSNR of every way; dotted the worst view, or at the largest size."""
    from .charts import FAMILIES
    from .figures import panels, save

    fig, axes = panels(len(AXES), 4.2, 3.8)
    for i, ((name, axis), ax) in enumerate(zip(AXES.items(), axes, strict=True)):
        for way in lines.ways:
            line = [(v, found.get((way, *lines.centre[:i], v, *lines.centre[i + 1 :]))) for v in getattr(lines, name)]
            there = [(v, m) for v, m in line if m]
            colour = FAMILIES[parse_spec(f"{way}:1").method]
            for key, style in (("psnr", "o-"), ("finer" if name == "size" else "worst", ":")):
                had = [(v, m[key]) for v, m in there if key in m]
                ax.plot([v for v, _ in had], [y for _, y in had], style, color=colour, ms=4,
                        label=way if key == "psnr" and not i else None)  # fmt: skip
        ax.set_xscale("log")
        ax.set_xticks(getattr(lines, name), getattr(lines, name))
        ax.minorticks_off()
        ax.set_xlabel(axis)
    axes[0].set_ylabel(f"PSNR in dB; dotted: worst view, of sizes at {max(lines.size)}²")
    axes[0].legend(frameon=False)
    save(fig, stem, command)
