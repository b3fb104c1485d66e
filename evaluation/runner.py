# SPDX-License-Identifier: GPL-3.0-or-later
"""The one runner: many reconstructions scored, several at a time, and again from where a run was interrupted.

runs = [Run(name, seq.root, method, inputs, targets, size, {"setup": "random"}), …]
rows = run_all(runs, Cache(out), Conditions(jobs=2))     # a row for each run, in their order
"""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import torch
from tqdm import tqdm

from ..datagen.readers import DEFAULTS, ReadOptions, described_by, open_sequence
from ..datagen.sequence import Sequence
from ..model.views import load_views
from . import protocol
from .cache import Cache
from .loading import collapsed, kept_inputs, kept_truth, thinned, without_depth
from .method_spec import MethodSpec
from .provenance import ROOT, file_hash, revision
from .scoring import costs, draw, evaluate_views, psnr_of_finer, reconstruct

WARM_UP_SECONDS = 0.1  # of a fit, before anything is timed


@dataclass(frozen=True)
class Run:
    """One reconstruction that is scored: which views of which Sequence go in, how, and which are looked at."""

    object: str  # name of the Sequence
    folder: Path
    method: MethodSpec
    inputs: tuple[int, ...]  # indices of views
    targets: tuple[int, ...]
    size: int  # pixels; a whole fraction of what was rendered
    labels: dict = field(default_factory=dict, compare=False)  # what tables group the row by
    still: bool = False  # all times collapsed to 0
    step: int = 1  # the inputs are of every step-th frame, and make a clip of their own
    reading: ReadOptions = DEFAULTS  # what the user said of the folder
    finer: int | None = None  # pixels at which PSNR is measured as well, to compare runs of several sizes


def told_of(seq: Sequence, reading: ReadOptions) -> ReadOptions:
    """What the user said of others' folders, where a Sequence is of these: what was rendered says all of it itself."""
    return reading if "read" in seq.provenance else DEFAULTS


@dataclass(frozen=True)
class Conditions:
    """What holds for all runs."""

    left_out: tuple[str, ...] = ()  # metrics that are not measured
    costs: bool = False  # measure also what files weigh, drawing takes and inputs cover (`scoring.COSTS`)
    scenes: bool = False  # keep the scenes
    device: str = "cpu"
    jobs: int = 1  # processes, one core each; 1: in this process
    one_thread: bool = False  # also where there is one job
    started: float = field(default_factory=time.time)
    deadline: float = float("inf")  # time.time() from which on no run is started


def key_of(run: Run, conditions: Conditions) -> str:
    """Names a row by all that has a say in it but the code: start with another folder after changing that."""
    how = (run.inputs, run.targets, run.size, run.still, run.step, conditions.left_out, conditions.device)
    parts = [_sequence_hash(run.folder), run.method.fingerprint, repr(how), str(conditions.costs)]
    parts += [repr(run.reading)] if run.reading != DEFAULTS else []  # rows of before know no such options
    parts += [f"finer {run.finer}"] if run.finer else []
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:20]


def _sequence_hash(folder: Path) -> str:
    return "".join(file_hash(path) for path in described_by(folder))


def run_all(runs: list[Run], cache: Cache, conditions: Conditions, description: str = "evaluating") -> list[dict]:
    """A row for each run, in their order: `scoring.evaluate_views`, the run's labels, its object and method. Rows that
    the cache has are taken from there, others kept there as soon as they are made; runs that the deadline left are
    missing."""
    known, keys = cache.rows(), [key_of(r, conditions) for r in runs]
    todo = {k: r for k, r in zip(keys, runs, strict=True) if k not in known}
    if conditions.scenes:
        todo |= {k: r for k, r in zip(keys, runs, strict=True) if k not in todo and not cache.scene(k)}
    with tqdm(total=len(runs), desc=description, unit="run", disable=None, initial=len(runs) - len(todo)) as bar:
        for row in _map(list(todo.items()), cache, conditions):
            if row:
                cache.add(row)
                known[row["key"]] = row
                bar.set_postfix_str(f"{row['object']} {row['method']}")
            bar.update()
    made = zip(keys, runs, strict=True)
    return [known[k] | r.labels | {"object": r.object, "method": r.method.label} for k, r in made if k in known]


def _map(todo: list[tuple[str, Run]], cache: Cache, conditions: Conditions) -> Iterator[dict | None]:
    """`_work` of every run, in this process or in several of one core each."""
    methods = [r.method for _, r in todo]
    jobs = min(conditions.jobs, len(todo))
    if jobs <= 1:
        threads = torch.get_num_threads()
        _start(cache, conditions, methods)
        try:
            yield from map(_work, todo)
        finally:
            torch.set_num_threads(threads)
        return
    os.environ["OMP_NUM_THREADS"] = "1"  # read when the children load their libraries
    context = multiprocessing.get_context("spawn")  # forked threads would hang
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None
    shared = (cache, replace(conditions, one_thread=True), methods, cores, context.Value("i", 0))
    with context.Pool(jobs, _start, shared) as pool:
        yield from pool.imap_unordered(_work, todo)


_process: dict = {}  # what a process holds from run to run


def _start(cache: Cache, conditions: Conditions, methods: list[MethodSpec], cores=None, number=None) -> None:
    if number:  # a child: the parent tells it when to stop
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    if cores:
        with number.get_lock():
            os.sched_setaffinity(0, {cores[number.value % len(cores)]})
            number.value += 1
    if conditions.one_thread:
        torch.set_num_threads(1)
    _process.update(cache=cache, conditions=conditions, methods=methods, warm=False)


def _work(job: tuple[str, Run]) -> dict | None:
    """The row of a run; None where there is no time left for it."""
    key, run = job
    conditions: Conditions = _process["conditions"]
    if time.time() >= conditions.deadline:
        return None
    if not _process["warm"]:
        warm_up(run, _process["methods"], conditions.device)
        _process["warm"] = True
    depth = any(m.has_depth for m in _process["methods"])
    row = score_run(run, conditions, _process["cache"], key, depth)
    told = {"key": key, "object": run.object, "method": run.method.label, "size": run.size, "views": len(run.inputs)}
    told |= {"has_depth": run.method.has_depth}
    told |= {"session": conditions.started, "elapsed": time.time() - conditions.started, "jobs": conditions.jobs}
    return row | run.labels | told | {"revision": _revision()}


def score_run(run: Run, conditions: Conditions, cache: Cache, key: str, load_depth: bool) -> dict:
    """`evaluate_views` of a run, with `costs` where they are asked for; its scene is kept where that is. load_depth:
    whether other runs will want the depth of the same views."""
    seq = open_sequence(run.folder, run.reading)
    load_depth = load_depth and all(seq.views[i].passes for i in run.inputs)
    views = kept_inputs(run.folder, run.inputs, load_depth or run.method.has_depth, run.size, run.reading)
    views = thinned(views if run.method.has_depth else without_depth(views), run.step)
    novel = tuple(protocol.novel(seq, list(run.inputs), list(run.targets)))
    truth = kept_truth(run.folder, run.targets, novel, run.size, run.reading)
    if run.still:
        views, truth = collapsed(views), replace(truth, views=collapsed(truth.views))
    row, scene = evaluate_views(views, run.method, truth, conditions.device, conditions.left_out)
    if run.finer:
        finer = kept_truth(run.folder, run.targets, novel, run.finer, run.reading)
        row["psnr_finer"] = psnr_of_finer(scene, views, finer)
    if conditions.costs:
        row |= costs(scene, views, truth, run.method, seq)
    if conditions.scenes:
        cache.keep_scene(key, scene)
    return row


def warm_up(run: Run, methods: list[MethodSpec], device: str = "cpu") -> None:
    """Every kind of method once on two views of a run, so that no timing holds the compilation of kernels (about
    fifteen seconds, the first time on a machine) or imports."""
    kinds = {(m.method, m.checkpoint, bool(m.refine), bool(m.counted), bool(m.budget)): m for m in methods}
    seq = open_sequence(run.folder, run.reading)
    for method in kinds.values():
        views = load_views(seq, run.inputs[:2], method.has_depth, run.size)
        brief = replace(method, refine=method.refine and WARM_UP_SECONDS, seconds=WARM_UP_SECONDS)
        if method.counted:
            brief = replace(brief, quality=None, steps=1)
        draw(reconstruct(views, brief, device), views[:1])


@lru_cache(maxsize=1)
def _revision() -> str | None:
    return revision(ROOT)[0]
