# SPDX-License-Identifier: GPL-3.0-or-later
"""The settings of a training run, and the options of `timesplat train` that fill them. Loads without torch."""

from __future__ import annotations

import argparse
import math
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Literal, get_args, get_origin, get_type_hints

from ...datagen.readers import DEFAULTS, ReadOptions, from_arguments
from ...datagen.readers import add_arguments as add_reading
from ...datagen.sequence import InputError
from .clip_groups import parse_mix


@dataclass(frozen=True)
class TrainConfig:
    """All that a training run depends on; `add_arguments` says what each means. Raises InputError, which names the
    option, for a value that no run can use."""

    data: tuple[Path, ...]  # Sequence folders, or folders that hold some at any depth; or those of `timesplat pack`
    out: Path

    # the network; None: as the preset has it
    preset: Literal["tiny", "small", "base", "large"] = "tiny"
    head: Literal["paper", "kinematic"] | None = None
    source: Literal["given", "sweep", "predicted"] | None = None
    depth_range: Literal["paper", "centred"] | None = None
    time: Literal["free", "aligned"] | None = None
    free: int | None = None
    motion: Literal["gaussian", "hexplane"] | None = None
    init: Path | None = None

    # its samples; None: as many views as the sampling has by default
    sampling: Literal["setups", "paper", "video", "static"] = "setups"
    views: int | None = None
    targets: int | None = None
    mix: str = "200:50:1"
    shrink: int = 1

    # how long, and by which steps
    steps: int = 100_000
    minutes: float | None = None
    rate: float = 4e-4
    warmup: int = 100
    optimizer: Literal["adamw", "muon"] = "adamw"
    accumulate: int = 1

    # weights of the losses beside the pictures' squared error
    perceptual: float = 0.5
    geometric: float = 0.0
    opacity: float = 0.0

    # the machine
    bf16: bool = False
    checkpointing: bool = False
    device: str = "cpu"
    cache: Path = Path("data/cache")
    workers: int = 0
    seed: int = 0
    reading: ReadOptions = DEFAULTS  # what is said of others' folders

    @classmethod
    def from_arguments(cls, args: argparse.Namespace) -> TrainConfig:
        """Of what a parser with `add_arguments` has parsed. Raises InputError."""
        values = {f.name: getattr(args, f.name) for f in fields(cls) if f.name != "reading"}
        return cls(**values | {"data": tuple(args.data), "reading": from_arguments(args)})

    def __post_init__(self) -> None:
        if not 0 < self.rate < math.inf:
            raise InputError(f"--rate {self.rate:g}: give a number above 0.")
        for name in ("steps", "shrink", "accumulate"):
            if getattr(self, name) < 1:
                raise InputError(f"--{name} {getattr(self, name)}: give a whole number above 0.")
        if self.workers < 0:
            raise InputError(f"--workers {self.workers}: give 0 or more processes.")
        parse_mix(self.mix)
        for field in fields(self):
            value, words = getattr(self, field.name), choices(field.name)
            if words and value not in (*words, field.default):
                raise InputError(f"--{field.name.replace('_', '-')} {value}: choose one of {', '.join(words)}.")
        if self.motion == "hexplane" and self.geometric:
            raise InputError("--geometric compares velocities, and a HexPlane has none; leave it out.")


def choices(name: str) -> tuple[str, ...]:
    """The words that a field of TrainConfig is one of; none for a field of another type."""
    hint = get_type_hints(TrainConfig)[name]
    return tuple(word for kind in (hint, *get_args(hint)) if get_origin(kind) is Literal for word in get_args(kind))


def add_arguments(p: argparse.ArgumentParser) -> None:
    """The options of `timesplat train`, with the defaults of TrainConfig."""

    def choice(option: str, text: str, name: str | None = None) -> None:
        name = name or option.removeprefix("--").replace("-", "_")
        p.add_argument(option, dest=name, choices=choices(name), help=text)

    p.add_argument("data", nargs="+", type=Path, help="folders of Sequences, or of shards; rendered with passes for "
                   "--source given and --geometric")  # fmt: skip
    p.add_argument("--out", type=Path, required=True, help="run folder; training goes on where it stands")
    choice("--preset", "network (default: %(default)s): base and large are the paper's, --head paper --source "
           "predicted; tiny and small are --head kinematic --source given; the six options below change what they "
           "name of it")  # fmt: skip
    choice("--head", "20 or 19 outputs a pixel (default: the preset's)")
    choice("--source", "where depth comes from (default: the preset's)")
    choice("--depth-range", "for --source predicted (default: paper)")
    choice("--time", "of a pixel: free (default), or its frame's")
    p.add_argument("--free", type=int, help="free Gaussians beside the pixels' (default: 0)")
    choice("--motion", "what moves Gaussians (default: gaussian)")
    p.add_argument("--init", type=Path, help="checkpoint to start from, instead of random weights")
    p.add_argument("--steps", type=int, help="stop after this many steps (default: %(default)s)")
    p.add_argument("--minutes", type=float, help="stop after this long; the learning rate follows the clock")
    choice("--sampling", "views of a sample: as the evaluation setups (default), of 36 at random, front video, of one "
           "frame")  # fmt: skip
    p.add_argument("--static", dest="sampling", action="store_const", const="static", help="short for --sampling "
                   "static")  # fmt: skip
    p.add_argument("--views", type=int, help="input views of a sample (default: 24; paper 12, video 27, static 4)")
    p.add_argument("--targets", type=int, help="supervision views of a sample (default: 8; paper 24, static 4)")
    p.add_argument("--mix", help="weights of much moving : moving : still clips, or uniform (default: %(default)s)")
    p.add_argument("--shrink", type=int, help="train at 1/N of the rendered size (curriculum; default: %(default)s)")
    p.add_argument("--rate", type=float, help="peak learning rate (default: %(default)g)")
    p.add_argument("--warmup", type=int, help="steps of linear warm-up (default: %(default)s; the paper's: 2000)")
    choice("--optimiser", "muon: for the blocks' matrices (default: %(default)s)", "optimizer")
    p.add_argument("--accumulate", type=int, help="samples per step (default: %(default)s)")
    p.add_argument("--perceptual", type=float, help="weight of the VGG-19 loss, if there are weights (default: "
                   "%(default)g)")  # fmt: skip
    p.add_argument("--geometric", type=float, help="weight of the geometric loss, for RGB sources (default: "
                   "%(default)g)")  # fmt: skip
    p.add_argument("--opacity", type=float, help="weight of the mean opacity (default: %(default)g)")
    p.add_argument("--bf16", action="store_true", help="run the transformer in bfloat16")
    p.add_argument("--checkpointing", action="store_true", help="keep less memory, compute blocks twice")
    p.add_argument("--device", help="cpu or cuda (default: %(default)s)")
    p.add_argument("--cache", type=Path, help="where packed clips are kept (default: %(default)s)")
    p.add_argument("--workers", type=int, help="processes that draw samples ahead; for shards 1 or 2 (default: "
                   "%(default)s)")  # fmt: skip
    p.add_argument("--seed", type=int, help="of weights and samples (default: %(default)s)")
    p.set_defaults(**{f.name: f.default for f in fields(TrainConfig) if f.default is not MISSING})
    add_reading(p)
