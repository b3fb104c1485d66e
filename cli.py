# SPDX-License-Identifier: GPL-3.0-or-later
"""`timesplat <command>`: thin, one function a command. Heavy imports happen inside the commands."""

from __future__ import annotations

import argparse
import io
import os
import shlex
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path

from . import __version__
from .exit_codes import NOBODY_READS, exit_code

EPILOG = """the road, step by step:
  timesplat render fox.glb --out data/fox --rig alternating     24 posed images with depth and motion
  timesplat reconstruct data/fox/fox/Run --out fox.ply           one 4D Gaussian asset
  timesplat export fox.ply fox.usdc                              for USD pipelines
  timesplat view fox.ply                                         in the browser
  timesplat video fox.ply fox.mp4                                a turntable that plays
all of it at once, with pictures and figures:
  timesplat demo fox.glb
"""


def main(argv: list[str] | None = None) -> int:
    """Runs a command and returns its exit code: 0, 2 where the input cannot be used, 141 where nobody reads on."""
    try:
        try:
            return _main(argv)
        finally:
            for stream in filter(None, (sys.stdout, sys.stderr)):
                stream.flush()
    except BrokenPipeError:
        for stream in filter(None, (sys.stdout, sys.stderr)):
            try:
                stream.flush()
            except BrokenPipeError:  # what is left goes nowhere, so that the interpreter's own flush has no complaint
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
        return NOBODY_READS


def _main(argv: list[str] | None) -> int:
    parser = argparse.ArgumentParser(
        prog="timesplat",
        description="Posed images at any times in, a 4D Gaussian asset out: any view, at any time.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"timesplat {__version__}")
    commands = parser.add_subparsers(dest="name", required=True, metavar="command")
    if argv is None:
        argv = sys.argv[1:]
    for name, (arguments, command, text) in COMMANDS.items():
        sub = commands.add_parser(name, help=text, description=(command.__doc__ or text))
        if name in argv:  # the others' arguments would only cost time
            arguments(sub)
        sub.set_defaults(run=command)
    for stream in (sys.stdout, sys.stderr):  # a console may lack letters of a file's name
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    args = parser.parse_args(argv)
    args.command = shlex.join(["timesplat", *map(str, argv)])  # for tables, which say by which command they were made
    return exit_code("timesplat", lambda: args.run(args))


# ---------------------------------------------------------------- inspect, import


def inspect_arguments(p: argparse.ArgumentParser) -> None:
    from .datagen.readers import LAYOUTS
    from .datagen.readers.options import add_arguments

    p.add_argument("folder", type=Path, help=f"pictures with cameras: a Sequence, or a folder of {LAYOUTS}")
    p.add_argument("--out", type=Path, help=".png to draw, of the cameras, the volume and the pictures over time "
                   "(default: inspect-FOLDER.png here)")  # fmt: skip
    add_arguments(p)


def inspect(args: argparse.Namespace) -> int:
    """Say what a folder of pictures and cameras holds: how many, whether the cameras agree, in which reading of their
    axes, what they see of the object, what is repeated, blurred or missing; and draw one picture of it."""
    from .datagen.inspection import inspect as run
    from .datagen.readers.options import from_arguments

    found = run(args.folder, from_arguments(args))
    for line in found.lines:
        print(line)
    from .evaluation.inspection_picture import write_picture

    out = args.out or Path(f"inspect-{args.folder.absolute().name}.png")
    write_picture(out, found.seq, found.lines)
    print(out)
    return 0


def import_arguments(p: argparse.ArgumentParser) -> None:
    from .datagen.readers import LAYOUTS
    from .datagen.readers.options import add_arguments
    from .datagen.writers import layout_argument

    p.add_argument("folder", type=Path, help=f"a Sequence, or a folder of {LAYOUTS}")
    p.add_argument("--out", type=Path, required=True, help="folder to write")
    layout_argument(p)
    add_arguments(p)


def import_(args: argparse.Namespace) -> int:
    """Write others' pictures and cameras as a Sequence: one size, straight lines, alpha, a normalised world. Or, with
    --layout, a Sequence (a render, a capture) or any of them as another program wants it."""
    from .datagen.inspection import counts
    from .datagen.readers import open_sequence
    from .datagen.readers.options import from_arguments
    from .datagen.writers import write_layout

    seq = open_sequence(args.folder, from_arguments(args))
    for line in [counts(seq), *seq.provenance.get("read", [])[1:]]:
        print(line)
    with _bar() as progress:
        write_layout(seq, args.out, args.layout, progress)
    print(f"{args.out}: {len(seq.views)} pictures")
    return 0


# ---------------------------------------------------------------- fetch, render, report, curate, pack


def fetch_arguments(p: argparse.ArgumentParser) -> None:
    from .datagen.objaverse import add_arguments

    add_arguments(p)


def fetch(args: argparse.Namespace) -> int:
    """Fetch objects of Objaverse with their licences, nothing twice, through the package `objaverse`."""
    from .datagen.objaverse import run

    return run(args)


def render_arguments(p: argparse.ArgumentParser) -> None:
    from .datagen.farm import add_arguments

    add_arguments(p)


def render(args: argparse.Namespace) -> int:
    """Render assets (glTF, FBX, OBJ, USD, .blend, procedural zoo) into Sequences: posed images, depth, motion."""
    from .datagen.farm import run

    return run(args)


def report_arguments(p: argparse.ArgumentParser) -> None:
    from .evaluation.render_report import add_arguments

    add_arguments(p)


def report(args: argparse.Namespace) -> int:
    """Say what a run of `render` made, what failed and why, what it cost, and with --project what more would take. Of a
    run by `--shard` it joins the tables."""
    from .evaluation.render_report import run

    return run(args)


def curate_arguments(p: argparse.ArgumentParser) -> None:
    from .datagen.curation.curate import add_arguments

    add_arguments(p)


def curate(args: argparse.Namespace) -> int:
    """Sort Sequences into the sets that training draws from, HQ4D, 4D and 3D, by how much they move, and throw out
    duplicates and artefacts: curation.csv, in which each decision can be overridden, and curation.html to look at."""
    from .datagen.curation.curate import run

    return run(args)


def pack_arguments(p: argparse.ArgumentParser) -> None:
    from .datagen.shards import add_arguments

    add_arguments(p)


def pack(args: argparse.Namespace) -> int:
    """Pack Sequences into WebDataset shards, from which `train` reads what it draws: pictures without loss, with or
    without passes, each clip with its licence; and a manifest. What is packed already stays."""
    from .datagen.shards import run

    return run(args)


# ---------------------------------------------------------------- train, reconstruct


def train_arguments(p: argparse.ArgumentParser) -> None:
    from .model.training.config import add_arguments

    add_arguments(p)


def train(args: argparse.Namespace) -> int:
    """Train a network on rendered Sequences; stops by --steps or --minutes, and goes on where it stood."""
    from .model.training.config import TrainConfig
    from .model.training.trainer import train as run

    run(TrainConfig.from_arguments(args))
    return 0


def reconstruct_arguments(p: argparse.ArgumentParser) -> None:
    from .model.reconstruct_command import add_arguments

    add_arguments(p)


def reconstruct(args: argparse.Namespace) -> int:
    """Reconstruct a Sequence as one 4D Gaussian asset (.ply)."""
    from .model import baselines  # noqa: F401, adds its methods
    from .model.reconstruct_command import run

    return run(args, _bar)


@contextmanager
def _bar() -> Iterator[Callable[[float, str], None]]:
    """A callback that shows on a terminal, after two seconds, how far something is; what is said of plans it prints."""
    from tqdm import tqdm

    with tqdm(total=100, unit="%", delay=2, leave=False, disable=None) as bar:

        def progress(fraction: float, text: str) -> None:
            if "planned" in text:
                bar.write(text)
            else:
                bar.set_description_str(text, refresh=False)
            bar.update(int(100 * fraction) - bar.n)

        yield progress


# ---------------------------------------------------------------- export, view


def export_arguments(p: argparse.ArgumentParser) -> None:
    from .model.io.export import add_export_arguments

    add_export_arguments(p)


def export(args: argparse.Namespace) -> int:
    """Export an asset: USD (Gaussian splats that older readers take as points), a web page that plays it, 3DGS .ply
    slices, or a .blend."""
    from .model.io.export import export as run

    return run(args)


def view_arguments(p: argparse.ArgumentParser) -> None:
    from .model.io.export import add_view_arguments

    add_view_arguments(p)


def view(args: argparse.Namespace) -> int:
    """Play an asset in the browser: writes the page of `timesplat export ASSET NAME.html` to a temporary file and opens
    it. Nothing is served, and nothing leaves the machine."""
    from .model.io.export import view as run

    return run(args)


def video_arguments(p: argparse.ArgumentParser) -> None:
    from .model.film_command import add_arguments

    add_arguments(p)


def video(args: argparse.Namespace) -> int:
    """Film an asset: a turntable that plays while it turns, or what cameras see, as .mp4, animated .webp or pictures
    with alpha."""
    from .model.film_command import run

    return run(args, _bar)


# ---------------------------------------------------------------- evaluate, bench, demo


def evaluate_arguments(p: argparse.ArgumentParser) -> None:
    from .evaluation.evaluate import add_arguments

    add_arguments(p)


def evaluate(args: argparse.Namespace) -> int:
    """Render what is not yet rendered, reconstruct with each method, score, write tables in the paper's layout."""
    from .datagen.readers.options import from_arguments
    from .evaluation.evaluate import EvaluateOptions, evaluate

    args.reading = from_arguments(args)
    return evaluate(options_of(EvaluateOptions, args))


def bench_arguments(p: argparse.ArgumentParser) -> None:
    from .evaluation.bench import add_arguments

    add_arguments(p)


def bench(args: argparse.Namespace) -> int:
    """Speed against accuracy: every way from posed images to novel views, on held-out objects, in some 25 minutes
    on two cores. Writes into --out: bench.csv (a row for each object and method), bench.md (means, machine, what is
    on the Pareto frontiers) and bench-*.png and .svg: quality against seconds and against size, Gaussian budgets,
    numbers of views and sizes, renderer samples. A run that was stopped goes on where it was."""
    from .datagen.readers.options import from_arguments
    from .evaluation.bench import BenchOptions, bench

    args.reading = from_arguments(args)
    return bench(options_of(BenchOptions, args))


def stress_arguments(p: argparse.ArgumentParser) -> None:
    from .evaluation.stress.command import add_arguments

    add_arguments(p)


def stress(args: argparse.Namespace) -> int:
    """Where methods fail: procedural scenes and inputs whose difficulty is one number each, swept from easy to
    impossible, with worst frames, ghosts, flicker and times that no input shows. Writes one page of charts and
    pictures, a table and figures into --out. Other people's methods: --scenes writes what they see, --score scores
    their pictures."""
    from .evaluation.stress.command import StressOptions, stress

    return stress(options_of(StressOptions, args))


def demo_arguments(p: argparse.ArgumentParser) -> None:
    from .evaluation.demo import add_arguments

    add_arguments(p)


def demo(args: argparse.Namespace) -> int:
    """Render an animated object, reconstruct it several ways, export it, and lay everything side by side."""
    from .evaluation.demo import DemoOptions, demo
    from .model.io.export import save_blend

    return demo(options_of(DemoOptions, args), save_blend)


def options_of(kind: type, args: argparse.Namespace):
    """The dataclass `kind` filled from the arguments of its fields' names."""
    return kind(**{f.name: getattr(args, f.name) for f in fields(kind) if hasattr(args, f.name)})


def extension_arguments(p: argparse.ArgumentParser) -> None:
    p.add_argument(
        "--out",
        type=Path,
        default=Path("dist"),
        help="folder for the .zip, which Blender installs from disk: Preferences, Get Extensions (default: dist)",
    )


def extension(args: argparse.Namespace) -> int:
    """Build the Blender extension's .zip."""
    from .addon.package import build

    print(build(args.out))
    return 0


COMMANDS = {
    "demo": (demo_arguments, demo, "the whole road in one go, with pictures"),
    "fetch": (fetch_arguments, fetch, "objects of Objaverse, with their licences"),
    "render": (render_arguments, render, "assets to Sequences (Blender)"),
    "report": (report_arguments, report, "what was rendered, what it cost, what more would"),
    "curate": (curate_arguments, curate, "Sequences into sets for training, and out"),
    "pack": (pack_arguments, pack, "Sequences into shards that train reads"),
    "inspect": (inspect_arguments, inspect, "what others' pictures and cameras are"),
    "import": (import_arguments, import_, "others' pictures to a Sequence"),
    "reconstruct": (reconstruct_arguments, reconstruct, "a Sequence to a 4D Gaussian asset"),
    "export": (export_arguments, export, "an asset to USD, a web page or .blend"),
    "view": (view_arguments, view, "play an asset in the browser"),
    "video": (video_arguments, video, "film an asset: .mp4, .webp, pictures"),
    "evaluate": (evaluate_arguments, evaluate, "score methods on held-out views"),
    "bench": (bench_arguments, bench, "speed against accuracy, in charts"),
    "stress": (stress_arguments, stress, "where methods fail, in charts"),
    "train": (train_arguments, train, "train a network on Sequences"),
    "extension": (extension_arguments, extension, "build the Blender extension"),
}

if __name__ == "__main__":
    sys.exit(main())
