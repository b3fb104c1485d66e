# SPDX-License-Identifier: GPL-3.0-or-later
"""`timesplat reconstruct`: which views, by which method, how much of it; see reconstruct.py."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..datagen.readers import LAYOUTS, open_sequence
from ..datagen.readers.options import add_arguments as add_reading
from ..datagen.readers.options import from_arguments
from ..datagen.sequence import InputError
from .fitting.quality import QUALITIES

if TYPE_CHECKING:
    from .methods import Progress


def add_arguments(p: argparse.ArgumentParser) -> None:
    """The arguments of `timesplat reconstruct`."""
    meanings = "; ".join(f"{n}: {q.size} pixels, {q.steps:,} steps, {q.gaussians:,}" for n, q in QUALITIES.items())
    p.add_argument("sequence", type=Path, help=f"folder that `timesplat render` wrote, or one of {LAYOUTS}")
    p.add_argument("--out", type=Path, required=True, help=".ply to write")
    add_reading(p)
    p.add_argument("--method", help="tracks, flow, lift, guided, deform, rgb, sweep, predicted, 4dgs (default: "
                   "tracks where there are surface tracks, else flow where there is depth, else deform)")  # fmt: skip
    p.add_argument("--quality", help="how much is fitted, and the same comes out however busy the machine is: the "
                   "longest side of the pictures, steps, most Gaussians. The pictures are averaged down by a whole "
                   "factor; a method that gains nothing from so many steps or Gaussians takes fewer; one that does not "
                   f"fit is refined. {meanings}. (default: for deform balanced, else none)")  # fmt: skip
    p.add_argument("--steps", type=int, help="exactly so many steps of the method's own fit, or of refinement where it "
                   "has none; in place of --quality")  # fmt: skip
    p.add_argument("--seconds", type=float, help="for methods that fit the scene: tracks, flow, deform, 4dgs; as many "
                   "steps are planned as fit (default: 10)")  # fmt: skip
    p.add_argument("--refine", type=float, default=0.0, help="seconds of fitting the result to the views (default: 0)")
    p.add_argument("--seed", type=int, default=0, help="of all that is random in fits (default: 0)")
    p.add_argument("--budget", help="most Gaussians: a number, a share of those predicted such as 10%%, or auto: as "
                   "many as the scene needs; fits them for --refine seconds, or 5")  # fmt: skip
    p.add_argument("--max-loss", type=float, default=0.1, help="dB that --budget auto may lose (default: 0.1)")
    p.add_argument("--size", type=int, metavar="PIXELS", help="read the pictures at this size of their longer side, a "
                   "whole fraction of theirs (default: theirs)")  # fmt: skip
    p.add_argument("--rig", help="use only the views of this rig")
    p.add_argument("--checkpoint", type=Path, help="weights in place of the shipped ones")
    p.add_argument("--device", default="cpu", help="cpu or cuda (default: cpu)")


def run(args: argparse.Namespace, bar: Callable[[], AbstractContextManager[Progress]]) -> int:
    """0. `bar` shows how far the fit is, and is gone before anything is said of the result. Raises InputError before
    anything is written."""
    from ..datagen.inspection import counts
    from .clip import clip_of
    from .devices import check_device
    from .fitting.budget import parse_budget
    from .geometry.coverage import coverage
    from .io.ply import write_ply
    from .methods import ReconstructOptions, method_named
    from .reconstruct import DEFAULTS, chosen_method, reconstruct, untracked_note
    from .views import load_views

    start = time.perf_counter()
    if args.seconds is not None and (args.quality or args.steps is not None):
        other = "--quality" if args.quality else "--steps"
        raise InputError(f"--seconds and {other}: each says how long a fit goes on; give one of them.")
    options = ReconstructOptions(
        device=args.device,
        checkpoint=args.checkpoint,
        seconds=DEFAULTS.seconds if args.seconds is None else args.seconds,
        refine=args.refine,
        quality=args.quality,
        steps=args.steps,
        seed=args.seed,
        budget=args.budget,
        max_loss=args.max_loss,
    )
    check_device(args.device)
    seq = open_sequence(args.sequence, from_arguments(args))
    if "read" in seq.provenance:  # of others' data, in two lines; `inspect` says more
        print(counts(seq))
        print("; ".join(seq.provenance["read"][1:]))
    rigs = sorted({v.rig for v in seq.views})
    if args.rig and args.rig not in rigs:
        raise InputError(f"{args.sequence}: no rig {args.rig}; it has {', '.join(rigs)}.")
    indices = seq.select(rig=args.rig) if args.rig else seq.inputs()
    method = method_named(chosen_method(seq, args.method, indices))
    if args.checkpoint and not method.checkpoint:
        raise InputError(
            f"{args.checkpoint}: {method.name} is no network and loads no weights; name one with --method."
        )
    if args.seconds is None and not (args.refine or options.counted):
        options = replace(options, quality=method.quality)
    with bar() as progress:
        g = reconstruct(seq, method.name, indices, options, progress, size=args.size)
    write_ply(args.out, g.to_asset(clip_of(seq)))
    taken = time.perf_counter() - start
    print(f"{args.out}: {len(g)} Gaussians from {len(indices)} views in {taken:.1f} s ({method.name})")
    wanted = parse_budget(args.budget) if args.budget else None
    if isinstance(wanted, int) and len(g) < 0.9 * wanted:
        print(f"{wanted:,} were asked for, which these pictures are not worth: give more or larger ones, or more steps")
    if method.has_depth and (note := untracked_note(seq)):
        print(note)
    if method.knows_surface and not (args.refine or args.budget or options.counted):
        share, _ = coverage(g, load_views(seq, indices, method.has_depth, args.size))
        print(f"coverage {share:.0%}" + ("" if share > 0.99 else ": what no camera saw is left open"))
    return 0
