# SPDX-License-Identifier: GPL-3.0-or-later
"""Scores: methods on views of rendered Sequences, many at a time, and again where a run was interrupted.

    views, truth = load_inputs(seq, chosen, passes=True), load_truth(seq, scored, fresh)
    row, scene = evaluate_views(views, "guided", truth)     # what `tables` sums up

`evaluate_folders` does this for objects x setups x sizes x methods, and writes every row to rows.jsonl at once.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import re
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d
from tqdm import tqdm

from ..datagen.sequence import InputError, Sequence, read_sequence, sequences_in
from ..model.fitting.budget import parse as parse_budget
from ..model.gaussians import DynamicScene, Gaussians4D
from ..model.parallel import work_clock
from ..model.rasterize import render
from ..model.rasterize.timeline import WORTH, Timeline
from ..model.reconstruct import CHECKPOINTS, METHODS, NEEDS_PASSES, WEIGHTS, reconstruct_views
from ..model.training.dataset import shrink
from ..model.views import Views, load_views
from . import protocol
from .flip import features, flip
from .lpips import LPIPS
from .metrics import psnr, psnr_foreground, ssim
from .provenance import Provenance
from .tables import (
    gather,
    summarise,
    table,
    write_metrics,
)

# What a method cannot do: the paper has no figures for these either.
NOT_FOR = {("gs-lrm-frame", "interpolation")}  # frames without a view


@dataclass(frozen=True)
class Method:
    """METHOD[+refine:SECONDS][+budget:N|P%|auto][+dense]"""

    name: str
    refine: float | None = None  # seconds of test-time optimisation
    budget: str | None = None  # most Gaussians, a share of those predicted, or auto
    dense: bool = False  # a network's tokens everywhere, not only where the object is

    @property
    def passes(self) -> bool:
        """Whether it sees depth and motion, not RGB and alpha alone."""
        return self.name in NEEDS_PASSES


def parse_method(spec: str) -> Method:
    """Raises InputError naming what is unknown, and what there is."""
    match = re.fullmatch(
        r"([^+]+)(?:\+refine:(\d+(?:\.\d+)?))?(?:\+budget:(\d+(?:\.\d+)?%|\d+|auto))?(\+dense)?", spec.strip()
    )
    if match and match[1] in METHODS:
        name, refine, budget, dense = match.groups()
        if budget:
            parse_budget(budget)
        return Method(name, refine and float(refine), budget, bool(dense))
    name = spec.strip().split("+")[0]
    if name not in METHODS:
        raise InputError(f"{name}: no such method; choose from {', '.join(METHODS)}.")
    raise InputError(f"{spec}: write {name}[+refine:SECONDS][+budget:N|P%|auto][+dense], in this order.")


# ---------------------------------------------------------------- one run


@dataclass
class Truth:
    """What predictions are compared with: V views at one size, and what metrics need of them, computed once."""

    views: Views
    picture: Tensor  # (V,H,W,3) over white
    novel: Tensor  # (V,) bool: no input shows it
    seen: dict[int, Tensor] = field(default_factory=dict)  # `flip.features` by view, made when asked for

    def features(self, i: int) -> Tensor:
        if i not in self.seen:
            self.seen[i] = features(self.picture[i])
        return self.seen[i]


def load_inputs(seq: Sequence, indices, passes: bool, size: int | None = None) -> Views:
    """Views at `size` pixels, a whole fraction of what was rendered (all of it by default). Raises InputError."""
    by = _fraction(seq, size)
    views = load_views(seq, indices, passes)
    if passes or by == 1:
        return shrink(views, by)
    nothing = replace(views, depth=torch.full_like(views.alpha, torch.inf), flow=views.alpha.new_zeros(()))
    nothing.flow = nothing.flow.expand(*views.alpha.shape, 4)
    return replace(shrink(nothing, by), depth=None, flow=None)


def load_truth(seq: Sequence, targets, novel, size: int | None = None) -> Truth:
    """The views `targets` at `size` pixels as truth; `novel` are those of them that no input shows."""
    views = load_views(seq, targets)
    picture, by = views.over(1.0), _fraction(seq, size)
    if by > 1:  # over white first: then light is averaged, and nothing else is to be weighted
        picture = avg_pool2d(picture.movedim(-1, 1), by).movedim(1, -1).contiguous()
        alpha = avg_pool2d(views.alpha[:, None], by)[:, 0]
        views = replace(views, rgb=picture, alpha=alpha, intrinsics=views.intrinsics / by)
    chosen = set(novel)
    return Truth(views, picture, torch.tensor([i in chosen for i in targets]))


def _fraction(seq: Sequence, size: int | None) -> int:
    by = seq.width // (size or seq.width)
    if by < 1 or (size and (size * by != seq.width or seq.height % by)):
        raise InputError(f"{seq.root}: {seq.width}x{seq.height} pixels do not shrink to {size}; give a whole fraction.")
    return by


def draw(g: Gaussians4D | DynamicScene, views: Views) -> tuple[Tensor, Tensor]:
    """Pictures (C,H,W,3) over white and alpha (C,H,W) of the scene from the cameras and times of views, with the
    paper's inference filters."""
    height, width = views.size
    if isinstance(g, Gaussians4D) and len(g) > WORTH:
        g = Timeline(g)
    with torch.no_grad():
        return render(g, views.c2w, views.intrinsics, views.time, width, height, inference=True)


def score(scene: Gaussians4D | DynamicScene, truth: Truth, lpips: LPIPS | None = None) -> dict[str, list]:
    """-> per view of truth, in its order: psnr, psnr_fg, ssim, lpips (None without its weights) and, of novel
    views alone, flip (None for the others, as it is dear); and whether the view is novel."""
    rgb, alpha = draw(scene, truth.views)
    novel = truth.novel.nonzero()[:, 0].tolist()
    seen = dict.fromkeys(range(len(truth.picture)))
    if novel:
        errors = flip(rgb[novel], truth.picture[novel], [truth.features(i) for i in novel])
        seen |= dict(zip(novel, errors.tolist(), strict=True))
    frames = {
        "psnr": psnr(rgb, truth.picture).tolist(),
        "psnr_fg": psnr_foreground(rgb, truth.picture, alpha, truth.views.alpha).tolist(),
        "ssim": ssim(rgb, truth.picture).tolist(),
        "lpips": lpips(rgb, truth.picture).tolist() if lpips else [None] * len(rgb),
        "flip": list(seen.values()),
        "novel": truth.novel.tolist(),
    }
    return {k: [round(x, 6) if isinstance(x, float) else x for x in v] for k, v in frames.items()}


def evaluate_views(
    views: Views,
    method: str,
    truth: Truth,
    checkpoint: Path | None = None,
    lpips: LPIPS | None = None,
    seconds: float = 10.0,
) -> tuple[dict, Gaussians4D | DynamicScene]:
    """Reconstructs from views (with depth and flow where the method needs them) and scores -> `summarise` of the
    scores, which are in `frames`; seconds of the reconstruction and of drawing and scoring a view; how many
    Gaussians there are, and are kept by the filters. And the scene, of those kept. `seconds` is what methods
    that fit a scene may take."""
    wanted = parse_method(method)
    start = work_clock()
    with torch.no_grad():  # methods that optimise turn gradients on again
        refine = wanted.refine or 0.0
        scene = reconstruct_views(
            views, wanted.name, checkpoint=checkpoint, seconds=seconds, refine=refine, budget=wanted.budget,
            dense=wanted.dense,
        )  # fmt: skip
        kept = scene[scene.alive()]
    taken = work_clock() - start
    frames = score(kept, truth, lpips)
    each = (work_clock() - start - taken) / len(truth.picture)
    row = {"seconds": taken, "seconds_scoring": each, "gaussians": len(scene), "gaussians_kept": len(kept)}
    return summarise(frames) | row | {"frames": frames}, kept


def evaluate_method(seq: Sequence, method: str, inputs, targets, checkpoint: Path | None = None):
    """`evaluate_views` of a Sequence's views `inputs`, on its views `targets` (indices)."""
    truth = load_truth(seq, targets, protocol.novel(seq, list(inputs), list(targets)))
    return evaluate_views(load_inputs(seq, inputs, parse_method(method).passes), method, truth, checkpoint)


def warm_up(seq: Sequence, inputs, methods: list[str], checkpoint: Path | None = None) -> None:
    """Runs every method once on two views, so that no timing holds the compilation of kernels (about fifteen
    seconds, the first time on a machine) or imports."""
    with torch.no_grad():
        for method in map(parse_method, methods):
            views = load_views(seq, inputs[:2], method.passes)
            refine = min(method.refine or 0.0, 0.1)
            scene = reconstruct_views(
                views, method.name, checkpoint=checkpoint, seconds=0.1, refine=refine, budget=method.budget
            )
            draw(scene, views[:1])


# ---------------------------------------------------------------- many runs


@dataclass(frozen=True)
class Plan:
    """What is scored on every object. setups: names of `protocol`, or "" for all views that are not held out;
    sizes in pixels, None for that of the Sequence; every `stride`-th frame (by size) counts."""

    methods: tuple[str, ...]
    setups: tuple[str, ...] = ("",)
    sizes: tuple[int | None, ...] = (None,)
    stride: tuple[int, ...] = (1,)  # one for all sizes, or one for each
    checkpoint: Path | None = None
    lpips: bool = True  # where its weights are found
    seconds: float = 10.0  # what methods that fit a scene may take
    deadline: float = float("inf")  # time.time() from which on no run is started
    jobs: int = 1

    def runs(self, setup: str) -> list[tuple[int | None, int, str]]:
        """(size, stride, method) of a setup."""
        stride = self.stride * len(self.sizes) if len(self.stride) == 1 else self.stride
        pairs = zip(self.sizes, stride, strict=True)
        return [(s, n, m) for s, n in pairs for m in self.methods if (parse_method(m).name, setup) not in NOT_FOR]


def key_of(seq: Sequence, setup: str, size: int | None, stride: int, method: str, plan: Plan, lpips: bool) -> str:
    """Names a row by all that has a say in it but the code: start with another folder after changing that."""
    weights = weights_of(method, plan.checkpoint)
    parts = [(seq.root / "transforms.json").read_bytes(), weights.read_bytes() if weights.is_file() else b""]
    parts.append(f"{setup} {size or seq.width} {stride} {method} {lpips} {plan.seconds}".encode())
    return hashlib.sha256(b"".join(hashlib.sha256(p).digest() for p in parts)).hexdigest()[:20]


def weights_of(method: str, checkpoint: Path | None = None) -> Path:
    """The checkpoint that a method loads, if it loads one."""
    name = parse_method(method).name
    return Path(checkpoint or CHECKPOINTS / f"{WEIGHTS.get(name, name)}.safetensors")


def evaluate_object(
    name: str, seq: Sequence, setup: str, plan: Plan, rows: Path, known: dict, lpips=None
) -> list[dict]:
    """All runs of a setup on one Sequence. Those in `known` {key: row} are taken from there, others are appended
    to the file `rows` as soon as they are made."""
    chosen = protocol.inputs(seq, setup) if setup else [i for i, v in enumerate(seq.views) if v.rig != "target"]
    passes = all(seq.views[i].passes for i in chosen) and any(parse_method(m).passes for m in plan.methods)
    found, at, views, truth = [], None, None, None
    for size, stride, method in plan.runs(setup):
        key = key_of(seq, setup, size, stride, method, plan, bool(lpips))
        if key in known:
            found.append(known[key] | {"object": name})
        elif time.time() < plan.deadline:
            if at != (size, stride):
                scored, at = protocol.targets(seq, stride), (size, stride)
                truth = load_truth(seq, scored, protocol.novel(seq, chosen, scored), size)
                views = load_inputs(seq, chosen, passes, size)
            what = replace(views, depth=None, flow=None) if not parse_method(method).passes else views
            row, _ = evaluate_views(what, method, truth, plan.checkpoint, lpips, plan.seconds)
            row |= {"key": key, "object": name, "setup": setup, "size": size or seq.width, "stride": stride}
            row |= {"method": method, "jobs": plan.jobs}
            append(rows, row)
            found.append(row)
    return found


def append(path: Path, row: dict) -> None:
    """A line of JSON in one write, so that lines of several processes never mix."""
    with open(path, "ab", buffering=0) as f:
        f.write((json.dumps(row) + "\n").encode())


def read_rows(path: Path) -> dict[str, dict]:
    """{key: row}; a line that was cut off is left out."""
    rows = {}
    for line in path.read_text().splitlines() if path.exists() else ():
        try:
            row = json.loads(line)
            rows[row["key"]] = row
        except (ValueError, KeyError):
            continue
    return rows


def evaluate_folders(
    sequences: dict[str, Sequence], methods: list[str], out: Path, checkpoint: Path | None = None, command="", **plan
) -> dict:
    """Scores every method on every Sequence {name: Sequence}; see `Plan` for keywords. Below `out`: rows.jsonl,
    from which an interrupted run goes on, metrics.json, metrics.md and tables.md, tables.csv (headed by
    `command`, the code's revision and the hashes of the checkpoints). Prints the table, returns the metrics."""
    plan = Plan(tuple(methods), checkpoint=checkpoint, **plan)
    out.mkdir(parents=True, exist_ok=True)
    units = [(name, seq, setup) for setup in plan.setups for name, seq in sequences.items()]
    with open(out / "rows.jsonl", "ab") as f:
        f.write(b"\n" if f.tell() else b"")  # ends a line that was cut off
    rows: list[dict] = []
    with tqdm(total=len(units), desc="evaluating", unit="setup", disable=None) as bar:
        for found in _map(units, plan, out / "rows.jsonl"):
            rows += found
            bar.update()
    if not rows:
        raise InputError(f"{out}: nothing was scored in the time given; allow more.")
    weights = [weights_of(m, plan.checkpoint) for m in plan.methods]
    metrics = gather(rows, Provenance.of(command, weights))
    write_metrics(out, metrics)
    print(table(metrics))
    return metrics


def _map(units: list, plan: Plan, rows: Path):
    """`evaluate_object` of every unit, in this process or in several of one core each."""
    if plan.jobs == 1:
        _start(plan, rows)
        yield from map(_work, units)
        return
    os.environ["OMP_NUM_THREADS"] = "1"  # read when the children load their libraries
    context = multiprocessing.get_context("spawn")  # forked threads would hang
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None
    number = context.Value("i", 0)
    with context.Pool(plan.jobs, _start, (plan, rows, cores, number)) as pool:
        yield from pool.imap(_work, [(n, s.root, u) for n, s, u in units])


_job: dict = {}  # what a process holds from unit to unit


def _start(plan: Plan, rows: Path, cores: list[int] | None = None, number=None) -> None:
    if cores:
        with number.get_lock():
            os.sched_setaffinity(0, {cores[number.value % len(cores)]})
            number.value += 1
        torch.set_num_threads(1)
    lpips = LPIPS.find() if plan.lpips else None
    _job.update(plan=plan, rows=rows, known=read_rows(rows), lpips=lpips, warm=False)


def _work(unit: tuple) -> list[dict]:
    name, seq, setup = unit
    seq = seq if isinstance(seq, Sequence) else read_sequence(seq)
    if not _job["warm"]:
        inputs = [i for i, v in enumerate(seq.views) if v.rig != "target"]
        warm_up(seq, inputs, _job["plan"].methods, _job["plan"].checkpoint)
        _job["warm"] = True
    return evaluate_object(name, seq, setup, *(_job[k] for k in ("plan", "rows", "known", "lpips")))


def find_sequences(assets: list[str]) -> tuple[dict[str, Sequence], list[str]]:
    """Of files and folders: the finished Sequences in them by name (their folder's above the clip's; with the
    clip's where an object has several), and those that hold none and are to be rendered."""
    folders, others = [], []
    for asset in assets:
        found = sequences_in(Path(asset))
        folders += found
        others += [] if found else [asset]
    objects = [f.parent.name for f in folders]
    names = [o if objects.count(o) == 1 else f"{o}/{f.name}" for o, f in zip(objects, folders, strict=True)]
    return {n: read_sequence(f) for n, f in zip(names, folders, strict=True)}, others
