# SPDX-License-Identifier: GPL-3.0-or-later
"""`timesplat bench`: speed against accuracy, every way from posed images to novel views on the same held-out objects.

A full cross of methods, inputs and sizes would take days, so the axes go through one centre: 24 views, one random one
a frame, 128x128 pixels. Scored are the held-out views (rig "target"), which no input shows. Seconds are processor
seconds of one thread. The pictures and the page are `charts`', from bench.csv alone.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace
from datetime import date
from importlib.util import find_spec
from pathlib import Path

from tqdm import tqdm

from ..datagen.readers import DEFAULTS, ReadOptions
from ..datagen.readers.options import add_arguments as add_reading
from ..datagen.sequence import InputError, Sequence

# No checkpoint was trained on these seeds, and nothing was tuned on them.
HELD_OUT = tuple(f"zoo:{seed}" for seed in range(1_000_100, 1_000_106))


@dataclass(frozen=True)
class Axes:
    """What is run: methods at the centre, and some of them at other sizes and numbers of views."""

    size: int = 128  # pixels, of the centre
    sizes: tuple[int, ...] = (64, 128, 256)
    views: tuple[int, ...] = (4, 8, 12, 48)
    centre: tuple[str, ...] = (
        *("lift", "guided", "rgb", "predicted", "gs-lrm-all", "gs-lrm-frame", "hull"),
        *("guided+dense", "rgb+dense", "predicted+dense"),
        *(f"{name}:{s}" for name in ("tracks", "flow", "deform", "4dgs", "som") for s in (1, 3, 10, 30)),
        *(f"{name}+refine:{s}" for name in ("guided", "rgb") for s in (1, 3, 10, 30)),
        *(f"rgb+refine:{s}" for s in (0.1, 0.3, 0.6, 2)),
        *(f"guided+refine:{s}+budget:{n}" for s in (3, 10) for n in ("2.5%", "5%", "10%", "25%", "auto")),
        *(f"rgb+refine:3+budget:{n}" for n in (500, 1000, "auto")),
    )
    elsewhere: tuple[str, ...] = (
        "tracks:3",
        "deform:3",
        "lift",
        "guided",
        "rgb",
        "guided+refine:3",
        "rgb+refine:3",
        "4dgs:3",
    )
    quick: float = 3.0  # seconds of fitting that a quick run has at the most


AXES = Axes()


@dataclass(frozen=True)
class BenchOptions:
    """What `timesplat bench` is asked for; see `add_arguments`."""

    assets: list[str]
    out: Path = Path("out/bench")
    command: str = ""  # as it was typed, for tables and charts
    objects: int | None = None
    quick: bool = False
    methods: str | None = None
    renderer: bool = False
    recipe: bool = False
    scaling: bool = False
    size: int = 128
    jobs: int = 2
    limit: float | None = None
    device: str = "cpu"
    draw: Path | None = None
    reading: ReadOptions = DEFAULTS  # what is said of others' folders


def add_arguments(p: argparse.ArgumentParser) -> None:
    """The arguments of `timesplat bench`."""
    d = BenchOptions([])
    p.add_argument("assets", nargs="*", help="animated files, zoo:SEED, Sequences rendered with --rig evaluation "
                   "--targets 1, or folders of either (default: 6 procedural objects no checkpoint saw)")  # fmt: skip
    p.add_argument("--out", type=Path, default=d.out, help="folder to write (default: %(default)s); another one after "
                   "changing the code, as rows are kept")  # fmt: skip
    p.add_argument("--objects", type=int, help="only the first N objects")
    p.add_argument("--quick", action="store_true", help="2 objects unless --objects says, no fit of more than 3 "
                   "seconds, no chart of the renderer: some 4 minutes")  # fmt: skip
    p.add_argument("--methods", help="only these, at the centre: comma-separated, written as in bench.csv, for "
                   "example guided,4dgs:10,rgb+refine:3")  # fmt: skip
    p.add_argument("--renderer", action="store_true", help="only the chart of the renderer: some 2 minutes")
    p.add_argument("--recipe", action="store_true", help="instead: the renderer against the field's recipe at equal "
                   "PSNR, 512 pixels; some 20 minutes, with --quick one at 128 pixels")  # fmt: skip
    p.add_argument("--scaling", action="store_true", help="instead: what methods make of more views, pixels and "
                   "seconds, along three lines through 96 views, 256 pixels and 30 s; some 2 hours on 4 objects, "
                   "with --quick 10 minutes on one")  # fmt: skip
    p.add_argument("--size", type=int, default=d.size, help="pixels to render at; 256 adds that size "
                   "(default: %(default)s)")  # fmt: skip
    p.add_argument("--jobs", type=int, default=d.jobs, help="processes, one core each (default: %(default)s)")
    p.add_argument("--limit", type=float, help="seconds after which nothing is started; the charts are then of what "
                   "all objects have, and the same command goes on")  # fmt: skip
    p.add_argument("--device", default=d.device, help="where methods run: cpu or cuda (default: %(default)s)")
    p.add_argument("--draw", type=Path, metavar="CSV", help="only draw again, from a bench.csv")
    add_reading(p)


def bench(options: BenchOptions) -> int:
    """The command; 2 where an object could not be rendered, else 0. Raises InputError."""
    _check(options)
    from . import charts

    if options.draw:
        print(charts.draw(options.draw))
        return 0
    started = time.time()
    options.out.mkdir(parents=True, exist_ok=True)
    if options.renderer:
        measure_renderer(options.out / "bench-renderer.csv", options.jobs)
        print(options.out / f"{charts.draw_renderer(options.out / 'bench-renderer.csv')}.png")
        return 0
    if options.recipe:
        from .recipe import compare

        compare(options.assets, options.out, quick=options.quick, jobs=options.jobs, command=options.command)
        print(options.out / "recipe.md")
        return 0
    if options.scaling:
        from .scaling import measure_scaling

        return 2 if measure_scaling(options, started) else 0
    failures = measure(options, started)
    print(charts.draw(options.out / "bench.csv"))
    return 2 if failures else 0


def _check(options: BenchOptions) -> None:
    """Raises InputError for options that cannot be, and for what is not installed, before anything runs."""
    if not find_spec("matplotlib"):
        raise InputError("matplotlib is not installed; pip install 'timesplat[figures]'.")
    if (options.renderer or options.recipe) and not find_spec("bpy"):
        raise InputError("bpy is not installed; pip install 'timesplat[render]'.")
    for name in ("objects", "jobs"):
        if getattr(options, name) is not None and getattr(options, name) < 1:
            raise InputError(f"--{name} {getattr(options, name)}: give 1 or more.")
    if options.limit is not None and options.limit <= 0:
        raise InputError(f"--limit {options.limit:g}: give more than 0 seconds.")
    if options.size % 64:
        raise InputError(f"--size {options.size}: give 64, 128 or 256.")


def measure(options: BenchOptions, started: float) -> list[str]:
    """Writes bench.csv; -> what could not be rendered."""
    from ..datagen.render_job import RenderSettings
    from ..model.devices import check_device
    from .bench_summary import bench_row, write_csv
    from .cache import Cache
    from .method_spec import parse_specs
    from .provenance import Provenance, machine, versions
    from .runner import Conditions, run_all, told_of

    check_device(options.device)
    chosen = [m.label for m in parse_specs(options.methods)] if options.methods else None
    number = options.objects or (2 if options.quick else None)
    cache, settings = Cache(options.out), RenderSettings(rig="evaluation", targets=1, size=options.size)
    assets = options.assets or list(HELD_OUT[:number])
    sequences, failures = cache.sequences(assets, settings, options.jobs, options.reading)
    sequences = dict(list(sequences.items())[:number])
    if not sequences:
        raise InputError(f"{options.assets[0]}: nothing to measure; none of the assets could be rendered.")
    points, notes = plan(sequences, options.quick, chosen)
    if not (options.quick or options.methods):
        measure_renderer(options.out / "bench-renderer.csv", options.jobs)
    deadline = started + options.limit if options.limit is not None else float("inf")
    how = Conditions(
        costs=True, one_thread=True, device=options.device, jobs=options.jobs, started=started, deadline=deadline
    )
    runs = [replace(r, reading=told_of(sequences[r.object], options.reading)) for r in runs_of(sequences, points)]
    rows = run_all(runs, cache, how, "measuring")
    if not rows:
        raise InputError(f"{options.out}: nothing was measured in the time given; allow more.")
    order = {(p.label, p.setup, p.size): i for i, p in enumerate(points)}
    rows = sorted(map(bench_row, rows), key=lambda r: order[r["way"], r["setup"], r["size"]])
    made = Provenance.of(options.command, [p.method.weights for p in points])
    facts = {
        "date": date.today().isoformat(),
        "machine": machine(),
        "versions": versions(),
        "jobs": options.jobs,
        "seconds_total": round(cache.seconds_spent(), 1),
        "centre": [points[0].setup, points[0].size],
        "notes": notes,
        "made_by": str(made),
    }
    write_csv(options.out / "bench.csv", rows, options.command, facts)
    return failures


# ---------------------------------------------------------------- what is run


@dataclass(frozen=True)
class Point:
    """A method in a setup of `protocol` ("" for all views that are not held out) at a size in pixels."""

    label: str
    setup: str
    size: int

    @property
    def method(self):
        """Its MethodSpec."""
        from .method_spec import parse_spec

        return parse_spec(self.label, seconds=10.0)


def plan(
    sequences: dict[str, Sequence], quick: bool = False, methods: list[str] | None = None, axes: Axes = AXES
) -> tuple[list[Point], list[str]]:
    """-> Points, those of the centre first; and sentences on what is left out, and why. `methods`: these alone, at the
    centre. Raises InputError where objects have nothing in common to be measured at."""
    from . import protocol
    from .method_spec import parse_spec

    for seq in sequences.values():
        protocol.held_out(seq)
    labels, notes = methods or [*axes.centre, *_other_weights()], []
    specs = {x: parse_spec(x, seconds=10.0) for x in labels}
    if lacking := [n for n, s in sequences.items() if not all(v.passes for v in s.views)]:
        notes.append(f"No depth-guided method: {lacking[0]} has no depth and motion passes.")
        labels = [x for x in labels if not specs[x].has_depth]
    labels = [x for x in labels if not quick or specs[x].fit_seconds <= axes.quick]
    setup = next(s for s in ("random", "alternating", "") if all(_has(seq, s) for seq in sequences.values()))
    if setup != "random":
        notes.append("Inputs are not random views, nor of other numbers: not every object has the rig `evaluation`.")
    sizes = [s for s in axes.sizes if all(seq.width % s == 0 and seq.height % s == 0 for seq in sequences.values())]
    size = axes.size if axes.size in sizes else next(iter(sequences.values())).width
    if axes.size not in sizes and any(seq.width != size for seq in sequences.values()):
        raise InputError(
            f"Objects are not of one size, nor of multiples of {axes.size} pixels; render them at {axes.size}."
        )
    points = [Point(x, setup, size) for x in labels]
    others = [] if methods else [x for x in axes.elsewhere if x in labels]
    points += [Point(x, setup, s) for s in sizes if s != size for x in others]
    counts = [f"views-{n}" for n in axes.views if setup == "random"]
    counts = [c for c in counts if all(_has(seq, c) for seq in sequences.values())]
    points += [Point(x, c, size) for c in counts for x in others]
    return points, notes


def _other_weights() -> list[str]:
    """Methods with shipped checkpoints of other sizes, which are named METHOD-….safetensors."""
    from ..model.checkpoints_io import CHECKPOINTS
    from ..model.methods import METHODS

    names = [(n, METHODS[n].checkpoint or n) for n in ("guided", "rgb", "predicted")]
    return [f"{n}@{f.stem[len(w) + 1 :]}" for n, w in names for f in sorted(CHECKPOINTS.glob(f"{w}-*.safetensors"))]


def _has(seq: Sequence, setup: str) -> bool:
    try:
        return bool(_inputs(seq, setup))
    except InputError:
        return False


def _inputs(seq: Sequence, setup: str) -> list[int]:
    from . import protocol

    return protocol.inputs(seq, setup) if setup else seq.inputs()


def runs_of(sequences: dict[str, Sequence], points: list[Point], axes: Axes = AXES) -> list:
    """A Run for each Point on each object {name: Sequence}: quick ones at the centre, quick ones elsewhere, then the
    slow ones by their seconds. Each stage goes object by object (what is loaded serves several), so that a session cut
    short has made whole points."""
    from . import protocol
    from .runner import Run

    stages: dict[tuple, list[Point]] = {}
    for p in points:
        fit, elsewhere = p.method.fit_seconds, (p.setup, p.size) != (points[0].setup, points[0].size)
        stages.setdefault((fit, False) if fit > axes.quick else (0, elsewhere), []).append(p)
    return [
        Run(
            n, seq.folder, p.method, tuple(_inputs(seq, p.setup)), tuple(protocol.held_out(seq)), p.size,
            {"setup": p.setup},
        )
        for k in sorted(stages) for n, seq in sequences.items() for p in stages[k]
    ]  # fmt: skip


# ---------------------------------------------------------------- the renderer


def measure_renderer(path: Path, jobs: int) -> None:
    """bench-renderer.csv, if there is none yet, and Blender: as many objects at a time as `jobs`, one core each."""
    if path.is_file() or not find_spec("bpy"):
        return
    from ..benchmarks import renderer
    from ..datagen.render_pool import cores
    from . import charts

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
