# SPDX-License-Identifier: GPL-3.0-or-later
"""`timesplat evaluate`: methods on objects, in the paper's setups, as tables in the paper's layout."""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ..datagen.readers import DEFAULTS, ReadOptions
from ..datagen.readers.options import add_arguments as add_reading
from ..datagen.rigs import SETUPS
from ..datagen.sequence import HELD_OUT, InputError, Sequence
from . import protocol

if TYPE_CHECKING:
    from .method_spec import MethodSpec
    from .runner import Run

# What a method cannot do: the paper has no figures for these either.
NOT_FOR = {("gs-lrm-frame", "interpolation")}  # frames without a view


@dataclass(frozen=True)
class EvaluateOptions:
    """What `timesplat evaluate` is asked for; see `add_arguments`."""

    assets: list[str]
    out: Path
    command: str = ""  # as it was typed, for the tables
    setup: str = "alternating"
    size: str = "128"
    split: str = "test"
    protocol: str | None = None
    stride: str = "1"
    samples: int = 16
    methods: str = "white,hull,lift,guided,sweep,predicted,rgb"
    checkpoint: Path | None = None
    jobs: int = 2
    seconds: float = 10.0
    limit: float | None = None
    lpips: bool = True
    seed: int = 0
    device: str = "cpu"
    reading: ReadOptions = DEFAULTS  # what is said of others' folders


def add_arguments(p: argparse.ArgumentParser) -> None:
    """The arguments of `timesplat evaluate`."""
    d = EvaluateOptions([], Path())
    p.add_argument("assets", nargs="+", help="animated files, zoo:SEED, rendered Sequences, scenes in the "
                   "format of D-NeRF, or folders of these")  # fmt: skip
    p.add_argument("--setup", default=d.setup, help="comma-separated: alternating, interpolation, rotating, "
                   "random (all: these four), video, canonical, random-N, views-N, split: all views but those held "
                   "out, scored on those of --split (default: %(default)s)")  # fmt: skip
    p.add_argument("--split", choices=list(HELD_OUT), default=d.split, help="for --setup split, which held-out "
                   "views are scored: those of rig target, or of rig val (default: %(default)s)")  # fmt: skip
    p.add_argument("--size", default=d.size, help="comma-separated pixels, multiples of 8 (default: %(default)s); "
                   "rendered at the largest, the others are whole fractions of it")  # fmt: skip
    p.add_argument("--protocol", choices=["paper"], help="score four canonical and a random view a frame also for one "
                   "setup and size, not the held-out views alone")  # fmt: skip
    p.add_argument("--stride", default=d.stride, help="score every Nth frame; one number, or one for each size "
                   "(default: %(default)s)")  # fmt: skip
    p.add_argument("--samples", type=int, default=d.samples, help="Cycles samples (default: %(default)s)")
    p.add_argument("--methods", default=d.methods, help="comma-separated METHOD[@CHECKPOINT][:SECONDS]"
                   "[+refine:SECONDS][+quality:NAME][+steps:N][+budget:N|P%%|auto][+dense], LABEL=… before "
                   "(default: %(default)s)")  # fmt: skip
    p.add_argument("--checkpoint", type=Path, help="weights for the one network method named")
    p.add_argument("--out", type=Path, required=True, help="folder for renders, metrics.json, tables.md, tables.csv")
    p.add_argument("--jobs", type=int, default=d.jobs, help="processes, one core each (default: %(default)s)")
    p.add_argument(
        "--seconds", type=float, default=d.seconds, help="for methods that fit a scene (default: %(default)s)"
    )
    p.add_argument("--limit", type=float, help="seconds after which no reconstruction is started; then the tables "
                   "are those of what there is, and the same command goes on")  # fmt: skip
    p.add_argument("--no-lpips", dest="lpips", action="store_false", help="leave LPIPS out even if it has weights")
    p.add_argument("--device", default=d.device, help="where methods run: cpu or cuda (default: %(default)s)")
    p.add_argument("--seed", type=int, default=d.seed)
    add_reading(p)


def evaluate(options: EvaluateOptions) -> int:
    """The command; 2 where an asset could not be rendered, else 0. Raises InputError."""
    from ..datagen.render_job import RenderSettings
    from ..model.devices import check_device
    from .cache import Cache, find_sequences
    from .lpips import HINT, find_lpips
    from .method_spec import parse_specs
    from .provenance import Provenance
    from .runner import Conditions, run_all
    from .tables import gather, table, write_metrics

    if options.seconds <= 0:
        raise InputError(f"--seconds {options.seconds:g}: give more than 0.")
    if options.jobs < 1:
        raise InputError(f"--jobs {options.jobs}: give 1 or more.")
    check_device(options.device)
    methods = parse_specs(options.methods, options.seconds, options.checkpoint)
    setups, sizes = _setups(options.setup), _sizes(options)
    several = len(setups) > 1 or len(sizes) > 1 or options.protocol == "paper"
    rig = "evaluation" if several or setups[0] not in SETUPS else setups[0]
    settings = RenderSettings(rig=rig, targets=1, size=max(sizes), samples=options.samples, seed=options.seed)

    cache, rendered = Cache(options.out), bool(find_sequences(options.assets, options.reading)[0])
    sequences, failures = cache.sequences(options.assets, settings, options.jobs, options.reading)
    if not sequences:
        raise InputError(f"{options.assets[0]}: nothing to evaluate; none of the assets could be rendered.")
    if options.lpips and not find_lpips():
        print(HINT, file=sys.stderr)
    conditions = Conditions(
        left_out=() if options.lpips else ("lpips",),
        device=options.device,
        jobs=min(options.jobs, len(setups) * len(sequences)) if several or rendered else 1,
        deadline=time.time() + options.limit if options.limit is not None else float("inf"),
    )
    runs = plan(sequences, methods, setups, sizes, options.split, options.reading)
    rows = run_all(runs, cache, conditions)
    if not rows:
        raise InputError(f"{options.out}: nothing was scored in the time given; allow more.")
    metrics = gather(rows, Provenance.of(options.command, [m.weights for m in methods]))
    write_metrics(options.out, metrics)
    print(table(metrics))
    return 2 if failures else 0


def plan(
    sequences: dict[str, Sequence],
    methods: list[MethodSpec],
    setups: list[str],
    sizes: dict[int, int],
    split: str = "test",
    reading: ReadOptions = DEFAULTS,
) -> list[Run]:
    """Every method on every Sequence {name: Sequence} in every setup ("" for all views that are not held out) at every
    size {pixels: score every n-th frame}; split: the held-out views that the setup "split" scores; reading: what was
    said of others' folders. Raises InputError where views are missing."""
    from .runner import Run, told_of

    runs = []
    for setup in setups:
        for name, seq in sequences.items():
            inputs = protocol.inputs(seq, setup) if setup else seq.inputs()
            for size, stride in sizes.items():
                scored = protocol.held_out(seq, split) if setup == "split" else protocol.targets(seq)
                targets = [i for i in scored if protocol.is_scored(seq, i, stride)]
                labels = {"setup": setup, "stride": stride}
                at = (tuple(inputs), tuple(targets), size, labels)
                able = [m for m in methods if (m.method, setup) not in NOT_FOR]
                runs += [Run(name, seq.folder, m, *at, reading=told_of(seq, reading)) for m in able]
    return runs


def _setups(text: str) -> list[str]:
    names = ",".join(protocol.TABLE) if text == "all" else text
    return list(dict.fromkeys(protocol.check_setup(s.strip()) for s in names.split(",")))


def _sizes(options: EvaluateOptions) -> dict[int, int]:
    """{pixels: stride}, small sizes first."""
    sizes, stride = _numbers("--size", options.size), _numbers("--stride", options.stride)
    if len(stride) not in (1, len(sizes)):
        raise InputError(f"--stride {options.stride}: give one number, or one for each of the {len(sizes)} sizes.")
    return dict(sorted(zip(sizes, stride * len(sizes), strict=False)))


def _numbers(option: str, text: str) -> list[int]:
    """Comma-separated whole numbers above 0. Raises InputError."""
    parts = [p.strip() for p in text.split(",")]
    if not all(p.isdigit() and int(p) > 0 for p in parts):
        raise InputError(f"{option} {text}: give numbers above 0, with commas between them.")
    return [int(p) for p in parts]
