# SPDX-License-Identifier: GPL-3.0-or-later
"""Speed against accuracy: every way from posed images to novel views, on the same held-out objects.

A way is written as in bench.csv: NAME[@WEIGHTS][:SECONDS][+OPTIONS], for example `guided`, `4dgs:10` (fitted for ten
seconds), `guided@small` (the checkpoint guided-small) or `guided+refine:10+budget:10%` (options as
`evaluate.parse_method` takes them). A full cross of ways, inputs and sizes would take days, so the axes go through
one centre: 24 views, one random one a frame, 128x128 pixels.

    points, notes = plan(sequences)
    rows = run(sequences, points, out)          # rows.jsonl, from which an interrupted run goes on

Scored are the held-out views (rig "target"), which no input shows. Seconds are processor seconds of one thread.
"""

from __future__ import annotations

import multiprocessing
import os
import re
import signal
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

import torch
from tqdm import tqdm

from ..datagen.sequence import InputError, Sequence, read_sequence
from ..model.fitting.budget import SECONDS
from ..model.geometry.coverage import SURFACES, coverage
from ..model.io.asset import write_ply
from ..model.parallel import work_clock
from ..model.reconstruct import CHECKPOINTS, METHODS, NEEDS_PASSES, WEIGHTS, clip_of
from ..model.views import Views
from . import protocol
from .evaluate import Plan, append, draw, evaluate_views, key_of, load_inputs, load_truth, parse_method, read_rows
from .evaluate import warm_up as warm_up_methods

# No checkpoint was trained on these seeds, and nothing was tuned on them.
HELD_OUT = [f"zoo:{seed}" for seed in range(1_000_100, 1_000_106)]
SIZE, SIZES = 128, (64, 128, 256)
FITS = (1, 3, 10, 30)  # seconds
BUDGETS = ("2.5%", "5%", "10%", "25%", "auto")
VIEWS = (4, 8, 12, 48)
CENTRE = ["lift", "guided", "rgb", "predicted", "gs-lrm-all", "gs-lrm-frame", "hull"]
CENTRE += ["guided+dense", "rgb+dense", "predicted+dense"]
CENTRE += [f"{name}:{s}" for name in ("4dgs", "som") for s in FITS]
CENTRE += [f"{name}+refine:{s}" for name in ("guided", "rgb") for s in FITS]
CENTRE += [f"rgb+refine:{s}" for s in (0.1, 0.3, 0.6, 2)]
CENTRE += [f"guided+refine:{s}+budget:{n}" for s in (3, 10) for n in BUDGETS]
CENTRE += [f"rgb+refine:3+budget:{n}" for n in (500, 1000, "auto")]
AXES = ["lift", "guided", "rgb", "guided+refine:3", "rgb+refine:3", "4dgs:3"]  # at other sizes and numbers of views
QUICK = 3.0  # seconds of fitting that a quick run has at the most

FIGURES = ["seconds", "psnr", "psnr_fg", "ssim", "flip", "gaussians", "ply_mb", "usd_mb", "render_ms"]
FIGURES += ["coverage"]  # of the object by the views, where it can be told
COLUMNS = ["object", "way", "setup", "views", "size", *FIGURES]


@dataclass(frozen=True)
class Way:
    """From views to a scene."""

    label: str
    name: str  # of METHODS
    spec: str  # what `evaluate.parse_method` takes
    weights: str = ""  # of the checkpoint, after the name of the method's own
    seconds: float = 0.0  # of fitting, for methods that fit a scene

    @property
    def passes(self) -> bool:
        """Whether it sees depth and motion, not RGB and alpha alone."""
        return self.name in NEEDS_PASSES

    @property
    def baseline(self) -> bool:
        return not METHODS[self.name].startswith("ours")

    @property
    def fit(self) -> float:
        """Seconds of fitting in all, without what `auto` takes to find its number."""
        wanted = parse_method(self.spec)
        return self.seconds + (wanted.refine or (SECONDS if wanted.budget else 0.0))

    @property
    def checkpoint(self) -> Path | None:
        return CHECKPOINTS / f"{WEIGHTS.get(self.name, self.name)}-{self.weights}.safetensors" if self.weights else None


def parse(label: str) -> Way:
    """Raises InputError for what is no way."""
    match = re.fullmatch(r"([^+@:]+)(?:@([\w-]+))?(?::(\d+(?:\.\d+)?))?(\+.+)?", label.strip())
    if not match:
        raise InputError(f"{label}: write a way as NAME[@WEIGHTS][:SECONDS][+OPTIONS], for example 4dgs:10.")
    name, weights, seconds, options = match.groups(default="")
    spec = name + options
    parse_method(spec)
    if (name in ("4dgs", "som")) != bool(seconds):
        raise InputError(f"{label}: 4dgs and som, and they alone, take seconds; write for example 4dgs:10.")
    way = Way(label.strip(), name, spec, weights, float(seconds or 0))
    if way.checkpoint and not way.checkpoint.is_file():
        raise InputError(f"{label}: there is no checkpoint {way.checkpoint.name}; name one in {CHECKPOINTS}.")
    return way


# ---------------------------------------------------------------- what is run


@dataclass(frozen=True)
class Point:
    """A way in a setup of `protocol` ("" for all views that are not held out) at a size in pixels."""

    label: str
    setup: str
    size: int


def plan(sequences: dict[str, Sequence], quick: bool = False, methods: list[str] | None = None):
    """-> Points, those of the centre first; and sentences on what is left out, and why. `methods`: these ways alone, at
    the centre. Raises InputError where objects have nothing in common to be measured at."""
    for seq in sequences.values():
        _held_out(seq)
    labels, notes = methods or [*CENTRE, *_other_weights()], []
    if lacking := [n for n, s in sequences.items() if not all(v.passes for v in s.views)]:
        notes.append(f"No depth-guided way: {lacking[0]} has no depth and motion passes.")
        labels = [x for x in labels if not parse(x).passes]
    labels = [x for x in labels if not quick or parse(x).fit <= QUICK]
    setup = next(s for s in ("random", "alternating", "") if all(_has(seq, s) for seq in sequences.values()))
    if setup != "random":
        notes.append("Inputs are not random views, nor of other numbers: not every object has the rig `evaluation`.")
    sizes = [s for s in SIZES if all(seq.width % s == 0 and seq.height % s == 0 for seq in sequences.values())]
    size = SIZE if SIZE in sizes else next(iter(sequences.values())).width
    if SIZE not in sizes and any(seq.width != size for seq in sequences.values()):
        raise InputError(f"Objects are not of one size, nor of multiples of {SIZE} pixels; render them at {SIZE}.")
    points = [Point(x, setup, size) for x in labels]
    others = [] if methods else [x for x in AXES if x in labels]
    points += [Point(x, setup, s) for s in sizes if s != size for x in others]
    counts = [f"views-{n}" for n in VIEWS if setup == "random"]
    counts = [c for c in counts if all(_has(seq, c) for seq in sequences.values())]
    points += [Point(x, c, size) for c in counts for x in others]

    return points, notes


def _other_weights() -> list[str]:
    """Ways with checkpoints of other sizes, which are named METHOD-….safetensors."""
    names = [(n, WEIGHTS.get(n, n)) for n in ("guided", "rgb", "predicted")]
    return [f"{n}@{f.stem[len(w) + 1 :]}" for n, w in names for f in sorted(CHECKPOINTS.glob(f"{w}-*.safetensors"))]


def _has(seq: Sequence, setup: str) -> bool:
    try:
        return bool(_chosen(seq, setup))
    except InputError:
        return False


def _chosen(seq: Sequence, setup: str) -> list[int]:
    return protocol.inputs(seq, setup) if setup else [i for i, v in enumerate(seq.views) if v.rig != "target"]


def _held_out(seq: Sequence) -> list[int]:
    found = seq.select(rig="target")
    if not found:
        raise InputError(f"{seq.root}: no held-out views to score; render it with --rig evaluation --targets 1.")
    return found


# ---------------------------------------------------------------- running


@lru_cache(maxsize=2)
def _views(root: Path, setup: str, size: int) -> Views:
    seq = read_sequence(root)
    chosen = _chosen(seq, setup)
    return load_inputs(seq, chosen, all(seq.views[i].passes for i in chosen), size)


@lru_cache(maxsize=4)
def _truth(root: Path, size: int):
    seq = read_sequence(root)
    return load_truth(seq, _held_out(seq), _held_out(seq), size)


def measure(name: str, seq: Sequence, point: Point) -> dict:
    """One row: COLUMNS of a Point on an object. None where a figure cannot be: a scene that is no 4D Gaussians has
    no files, for example."""
    way, views, truth = parse(point.label), _views(seq.root, point.setup, point.size), _truth(seq.root, point.size)
    what = views if way.passes else replace(views, depth=None, flow=None)
    row, scene = evaluate_views(what, way.spec, truth, way.checkpoint, None, way.seconds)
    start = work_clock()
    draw(scene, truth.views)
    row["render_ms"] = 1000 * (work_clock() - start) / len(truth.picture)
    row["ply_mb"], row["usd_mb"] = megabytes(scene, seq)
    row["coverage"] = coverage(scene, what)[0] if way.spec in SURFACES else None
    row |= {"gaussians": row["gaussians_kept"], "object": name, "way": way.label, "setup": point.setup}
    row |= {"views": len(views), "size": point.size}
    return {k: row[k] for k in COLUMNS}


def megabytes(scene, seq: Sequence) -> tuple[float | None, float | None]:
    """Of the scene as .ply and, where pxr is installed, as .usdc."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        ply, usd = Path(folder) / "a.ply", Path(folder) / "a.usdc"
        try:
            asset = scene.to_asset(clip_of(seq))
        except InputError:
            return None, None
        write_ply(ply, asset)
        if find_spec("pxr"):
            from ..model.io.usd_write import write_usd

            write_usd(usd, asset)
        return ply.stat().st_size / 1e6, usd.stat().st_size / 1e6 if usd.exists() else None


def key(seq: Sequence, point: Point) -> str:
    """Names a row by all that has a say in it but the code, as `evaluate.key_of` does."""
    way = parse(point.label)
    how = Plan((), checkpoint=way.checkpoint, seconds=way.seconds)
    return key_of(seq, point.setup, point.size, 1, way.spec, how, False)


def run(
    sequences: dict[str, Sequence],
    points: list[Point],
    out: Path,
    jobs: int = 1,
    deadline: float = float("inf"),
    started: float | None = None,
) -> list[dict]:
    """Every Point on every object {name: Sequence}; -> rows, in the order of the points. Those in out/rows.jsonl are
    taken from there, others appended as soon as they are made. Nothing is started after `deadline` (time.time());
    `started` is when the session began, for `spent`."""
    out.mkdir(parents=True, exist_ok=True)
    with open(out / "rows.jsonl", "ab") as f:
        f.write(b"\n" if f.tell() else b"")  # ends a line that was cut off
    known = read_rows(out / "rows.jsonl")
    units = [(n, p) for i in _stages(points) for n in sequences for p in i]
    keys = {u: key(sequences[u[0]], u[1]) for u in units}
    todo = [(n, sequences[n].root, p, keys[n, p]) for n, p in units if keys[n, p] not in known]
    setting = (started or time.time(), deadline, [p.label for _, _, p, _ in todo])
    with tqdm(total=len(units), initial=len(units) - len(todo), desc="measuring", unit="run", disable=None) as bar:
        for row in _map(todo, setting, jobs):
            if row:
                append(out / "rows.jsonl", row)
                known[row["key"]] = row
            bar.update()
    order = [(n, p) for p in points for n in sequences]
    return [known[keys[u]] | {"object": u[0]} for u in order if keys[u] in known]


def _stages(points: list[Point]) -> list[list[Point]]:
    """Quick ones at the centre, quick ones elsewhere, then the slow ones by their seconds: each stage is made object by
    object (what is loaded serves several), and a run cut short has made whole points."""
    stages: dict[tuple, list[Point]] = {}
    for p in points:
        fit = parse(p.label).fit
        elsewhere = (p.setup, p.size) != (points[0].setup, points[0].size)
        stages.setdefault((fit, False) if fit > QUICK else (0, elsewhere), []).append(p)
    return [stages[k] for k in sorted(stages)]


def spent(rows_file: Path) -> float:
    """Seconds by the clock that all sessions that wrote to a rows.jsonl took."""
    sessions: dict[float, float] = {}
    for row in read_rows(rows_file).values():
        if "session" in row:
            sessions[row["session"]] = max(sessions.get(row["session"], 0.0), row["elapsed"])
    return sum(sessions.values())


_setting: dict = {}


def _map(units: list, setting: tuple, jobs: int) -> Iterator[dict | None]:
    """`_work` of every unit, in this process or in several of one core each; one thread each."""
    if jobs == 1:
        threads = torch.get_num_threads()
        _start(setting)
        try:
            yield from map(_work, units)
        finally:
            torch.set_num_threads(threads)
        return
    os.environ["OMP_NUM_THREADS"] = "1"  # read when the children load their libraries
    context = multiprocessing.get_context("spawn")  # forked threads would hang
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None
    with context.Pool(min(jobs, max(len(units), 1)), _start, (setting, cores, context.Value("i", 0))) as pool:
        yield from pool.imap_unordered(_work, units)


def _start(setting: tuple, cores: list[int] | None = None, number=None) -> None:
    if number:  # a child: the parent tells it when to stop
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    if cores:
        with number.get_lock():
            os.sched_setaffinity(0, {cores[number.value % len(cores)]})
            number.value += 1
    torch.set_num_threads(1)
    _setting.update(zip(("started", "deadline", "labels"), setting, strict=True), warm=False)


def _work(unit: tuple) -> dict | None:
    name, root, point, key = unit
    if time.time() >= _setting["deadline"]:
        return None
    seq = read_sequence(root)
    if not _setting["warm"]:
        _warm_up(seq, _chosen(seq, point.setup), _setting["labels"])
        _setting["warm"] = True
    row = measure(name, seq, point)
    return row | {"key": key, "session": _setting["started"], "elapsed": time.time() - _setting["started"]}


def _warm_up(seq: Sequence, inputs: list[int], labels: list[str]) -> None:
    """Every kind of way once, on two views, so that no timing holds compilation or imports."""
    kinds = {}
    for way in map(parse, labels):
        m = parse_method(way.spec)
        kinds.setdefault((m.name, bool(m.refine), bool(m.budget)), way.spec)
    warm_up_methods(seq, inputs, list(kinds.values()))
