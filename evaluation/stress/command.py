# SPDX-License-Identifier: GPL-3.0-or-later
"""`timesplat stress`: its options, and what they lead to."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from ...datagen.sequence import InputError
from .sweeps import SWEEPS

METHODS = "tracks+steps:150,flow+steps:150,guided,deform+steps:300,4dgs+steps:300,rgb"
QUICK_METHODS = "tracks+steps:60,flow+steps:60,guided,deform+steps:100,4dgs+steps:150,rgb"
ABOUT = (
    "Each sweep is one difficulty, from easy to hard. PSNR and FLIP over whole moments from a random pose at each and "
    "a camera that stands still, over white; a cross marks where 3 dB of the first level's are lost. ghost: alpha "
    "where the truth is empty, in percent of all that is there; flicker: mean error of the change from one moment to "
    "the next, in 255ths, over what is shown; between: PSNR at the quarters between the moments that inputs show, less "
    "that at the moments, both of the camera that stands still."
)


@dataclass(frozen=True)
class StressOptions:
    """What `timesplat stress` is asked for; see `add_arguments`."""

    out: Path
    command: str = ""  # as it was typed
    quick: bool = False
    sweeps: str | None = None
    methods: str | None = None
    jobs: int = 2
    scenes: Path | None = None
    score: Path | None = None
    name: str | None = None

    @property
    def size(self) -> int:
        """Pixels, of trials that are not about sizes."""
        return 64 if self.quick else 96

    @property
    def samples(self) -> int:
        """A pixel."""
        return 8 if self.quick else 16


def add_arguments(p: argparse.ArgumentParser) -> None:
    """The arguments of `timesplat stress`."""
    d = StressOptions(Path())
    p.add_argument("--out", type=Path, required=True, help="folder for scenes, stress.csv (a line for each "
                   "reconstruction: the same command goes on where it was stopped), stress.html, stress.md and "
                   "stress.png; another one after changing the code")  # fmt: skip
    p.add_argument("--quick", action="store_true", help="half of the sweeps, two or three levels each, at 64 pixels")
    p.add_argument("--sweeps", help=f"comma-separated, of {', '.join(SWEEPS)} (default: all)")
    p.add_argument("--methods", help="comma-separated, as `timesplat evaluate` takes them; by steps, figures are "
                   f"the same on a busy machine (default: {METHODS}; with --quick {QUICK_METHODS})")  # fmt: skip
    p.add_argument("--jobs", type=int, default=d.jobs, help="processes of one thread each (default: %(default)s)")
    p.add_argument("--scenes", type=Path, metavar="FOLDER", help="for other people's methods: only write each "
                   "condition's inputs as a Sequence, and the cameras and times to be rendered")  # fmt: skip
    p.add_argument("--score", type=Path, metavar="FOLDER", help="add the pictures that another method made of those "
                   "cameras, FOLDER/CONDITION/NAME.png, to the figures and the report of --out")  # fmt: skip
    p.add_argument("--name", help="what --score calls that method (default: the folder's name)")


def stress(options: StressOptions) -> int:
    """The command. Raises InputError."""
    from ..method_spec import parse_specs
    from ..provenance import Provenance
    from . import report
    from .cells import Cell, key_of, run
    from .recipe import fingerprint, score, write_scenes
    from .scenes import render
    from .sweeps import sweeps_named

    if not find_spec("matplotlib"):
        raise InputError("matplotlib is not installed; pip install 'timesplat[figures]'.")
    if options.jobs < 1:
        raise InputError(f"--jobs {options.jobs}: give 1 or more.")
    if options.name and not options.score:
        raise InputError("--name: it names what --score scores; drop it.")
    methods = parse_specs(options.methods or (QUICK_METHODS if options.quick else METHODS))
    sweeps = sweeps_named(options.sweeps, options.quick)
    conditions = {s.name: s.conditions(options.quick, options.size) for s in sweeps}
    each = list(dict.fromkeys(c for found in conditions.values() for c in found.values()))
    if options.score and not options.score.is_dir():
        raise InputError(f"{options.score}: no such folder; give one with a folder of pictures for each condition.")
    render(options.out, each, options.samples, options.jobs)
    if options.scenes:
        count = write_scenes(options.scenes, options.out, each, options.samples)
        print(f"{options.scenes}: {count} conditions, each with inputs and held-out cameras")
        return 0

    told = {m.label: m.fingerprint for m in methods}
    rows = {}
    if options.score:
        label = options.name or options.score.absolute().name
        rows = score(options.score, label, options.out, each, options.samples)
        told = {label: fingerprint(options.score, label)} | (told if options.methods else {})
    if options.methods or not options.score:
        rows |= run(options.out, [Cell(c, m, options.samples) for c in each for m in methods], options.jobs)
    results = []
    for s in sweeps:
        found = {
            label: {x: rows[key_of(c, print_, options.samples)] for x, c in conditions[s.name].items()}
            for label, print_ in told.items()
        }
        results.append(report.Result(s, found))
    made_by = Provenance.of(options.command, [m.weights for m in methods])
    print(report.write(options.out, results, made_by, ABOUT))
    print(options.out / "stress.html")
    return 0
