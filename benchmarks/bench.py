# SPDX-License-Identifier: GPL-3.0-or-later
"""`timesplat bench`: objects rendered, everything measured (`model.bench`, `benchmarks.renderer`), charts drawn."""

from __future__ import annotations

import argparse
import shlex
import time
from collections.abc import Callable
from datetime import date
from importlib.util import find_spec
from pathlib import Path

from tqdm import tqdm

from timesplat.benchmarks import charts, renderer
from timesplat.datagen.farm import cores
from timesplat.datagen.render_job import RenderSettings
from timesplat.datagen.sequence import InputError


def command_line(args: argparse.Namespace) -> str:
    """What makes these figures again, without what says how fast."""
    words = ["timesplat", "bench", *args.assets, "--out", str(args.out), "--jobs", str(args.jobs)]
    words += [
        w for k in ("objects", "methods", "limit") if getattr(args, k) is not None for w in (f"--{k}", getattr(args, k))
    ]
    words += ["--quick"] * args.quick + ["--size", args.size] * (args.size != 128)
    return shlex.join(map(str, words))


def check(args: argparse.Namespace) -> None:
    """Raises InputError for options that cannot be, and for what is not installed, before anything runs."""
    if not find_spec("matplotlib"):
        raise InputError("matplotlib is not installed; pip install 'timesplat[figures]'.")
    if args.renderer and not find_spec("bpy"):
        raise InputError("bpy is not installed; pip install 'timesplat[render]'.")
    for k in ("objects", "jobs"):
        if getattr(args, k) is not None and getattr(args, k) < 1:
            raise InputError(f"--{k} {getattr(args, k)}: give 1 or more.")
    if args.limit is not None and args.limit <= 0:
        raise InputError(f"--limit {args.limit:g}: give more than 0 seconds.")
    if args.size % 64:
        raise InputError(f"--size {args.size}: give 64, 128 or 256.")


def run(args: argparse.Namespace, render_into: Callable) -> int:
    """The command; `render_into` as in cli. -> 2 where an object could not be rendered, else 0."""
    check(args)
    if args.draw:
        print(charts.draw(args.draw))
        return 0
    started = time.time()
    args.out.mkdir(parents=True, exist_ok=True)
    if args.renderer:
        samples(args.out / "bench-renderer.csv", args.jobs)
        print(args.out / f"{charts.draw_renderer(args.out / 'bench-renderer.csv')}.png")
        return 0
    failures = measure(args, render_into, started)
    print(charts.draw(args.out / "bench.csv"))
    return 2 if failures else 0


def measure(args: argparse.Namespace, render_into: Callable, started: float) -> list[str]:
    """bench.csv; -> what could not be rendered."""
    from timesplat.model import bench
    from timesplat.model.evaluate import find_sequences
    from timesplat.model.pareto import write_csv
    from timesplat.model.tables import machine, versions

    methods = [m for m in args.methods.split(",") if m.strip()] if args.methods else None
    for label in methods or ():
        bench.parse(label)
    number = args.objects or (2 if args.quick else None)
    sequences, others = find_sequences(args.assets or bench.HELD_OUT[:number])
    settings = RenderSettings(rig="evaluation", targets=1, size=args.size)
    failures = render_into(args.out / "renders", others, settings, args.jobs, sequences)
    sequences = dict(list(sequences.items())[:number])
    if not sequences:
        raise InputError(f"{args.assets[0]}: nothing to measure; none of the assets could be rendered.")
    points, notes = bench.plan(sequences, args.quick, methods)
    if not (args.quick or args.methods):
        samples(args.out / "bench-renderer.csv", args.jobs)
    deadline = started + args.limit if args.limit is not None else float("inf")
    rows = bench.run(sequences, points, args.out, args.jobs, deadline, started)
    if not rows:
        raise InputError(f"{args.out}: nothing was measured in the time given; allow more.")
    facts = {
        "date": date.today().isoformat(),
        "machine": machine(),
        "versions": versions(),
        "jobs": args.jobs,
        "seconds_total": round(bench.spent(args.out / "rows.jsonl"), 1),
        "centre": [points[0].setup, points[0].size],
        "notes": notes,
    }
    write_csv(args.out / "bench.csv", rows, command_line(args), facts)
    return failures


def samples(path: Path, jobs: int) -> None:
    """bench-renderer.csv, if there is none yet, and Blender: as many objects at a time as `jobs`, one core each."""
    if path.is_file() or not find_spec("bpy"):
        return
    rows: list[dict] = []
    with tqdm(total=len(renderer.OBJECTS), desc="renderer", unit="object", disable=None) as bar:
        for first in range(0, len(renderer.OBJECTS), jobs):
            batch, children = renderer.OBJECTS[first : first + jobs], []
            try:
                children += [renderer.start(a, cores()[i % len(cores())]) for i, a in enumerate(batch)]
                for child, asset in zip(children, batch, strict=True):
                    rows += renderer.finish(child, asset)
                    bar.update()
            finally:
                for child in children:
                    child.kill()
    charts.write_renderer(path, rows, "timesplat bench --renderer")
