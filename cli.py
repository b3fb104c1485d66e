# SPDX-License-Identifier: GPL-3.0-or-later
"""`timesplat <command>`: thin, one function a command. Heavy imports happen inside the commands."""

from __future__ import annotations

import argparse
import io
import os
import shlex
import sys
from pathlib import Path

from . import __version__
from .datagen.sequence import InputError

EPILOG = """the road, step by step:
  timesplat render fox.glb --out data/fox --rig alternating     24 posed images with depth and motion
  timesplat reconstruct data/fox/fox/Run --out fox.ply           one 4D Gaussian asset
  timesplat export fox.ply fox.usdc                              for USD pipelines
all of it at once, with pictures and figures:
  timesplat demo fox.glb
"""


PIPE_CLOSED = 141  # what a shell says of a program that SIGPIPE ended


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
        return PIPE_CLOSED


def _main(argv: list[str] | None) -> int:
    parser = argparse.ArgumentParser(
        prog="timesplat",
        description="Posed images at any times in, a 4D Gaussian asset out: any view, at any time.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"timesplat {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="command")
    for name, (arguments, command, text) in COMMANDS.items():
        sub = commands.add_parser(name, help=text, description=(command.__doc__ or text))
        arguments(sub)
        sub.set_defaults(run=command)
    if argv is None:
        argv = sys.argv[1:]
    for stream in (sys.stdout, sys.stderr):  # a console may lack letters of a file's name
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    args = parser.parse_args(argv)
    args.typed = shlex.join(["timesplat", *map(str, argv)])  # for tables, which say by which command they were made
    try:
        return args.run(args) or 0
    except InputError as e:
        print(f"timesplat: {e}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("timesplat: stopped; what was complete is kept, and the same command goes on.", file=sys.stderr)
        return 130
    except ModuleNotFoundError as e:
        extra = {"bpy": "render", "OpenEXR": "render", "torch": "torch", "numba": "torch", "pxr": "usd"}
        name = (e.name or "").split(".")[0]
        if name not in extra:
            raise
        print(f"timesplat: {name} is not installed; pip install 'timesplat[{extra[name]}]'.", file=sys.stderr)
        return 2


# ---------------------------------------------------------------- render


def render_arguments(p: argparse.ArgumentParser) -> None:
    from .datagen.render import add_arguments

    add_arguments(p)


def render(args: argparse.Namespace) -> int:
    """Render assets (glTF, FBX, OBJ, USD, .blend, procedural zoo) into Sequences: posed images, depth, motion."""
    from .datagen.render import run

    return run(args)


# ---------------------------------------------------------------- train, reconstruct


def train_arguments(p: argparse.ArgumentParser) -> None:
    p.add_argument("data", nargs="+", type=Path, help="folders of Sequences; rendered with passes for --source given "
                   "and --geometric")  # fmt: skip
    p.add_argument("--out", type=Path, required=True, help="run folder; training goes on where it stands")
    p.add_argument("--preset", choices=["tiny", "small", "base", "large"], default="tiny", help="network (default: "
                   "tiny): base and large are the paper's, --head paper --source predicted; tiny and small are --head "
                   "kinematic --source given; the six options below change what they name of it")  # fmt: skip
    p.add_argument("--head", choices=["paper", "kinematic"], help="20 or 19 outputs a pixel (default: the preset's)")
    p.add_argument("--source", choices=["given", "sweep", "predicted"], help="where depth comes from (default: the "
                   "preset's)")  # fmt: skip
    p.add_argument("--depth-range", choices=["paper", "centred"], help="for --source predicted (default: paper)")
    p.add_argument("--time", choices=["free", "aligned"], help="of a pixel: free (default), or its frame's")
    p.add_argument("--free", type=int, help="free Gaussians beside the pixels' (default: 0)")
    p.add_argument("--motion", choices=["gaussian", "hexplane"], help="what moves Gaussians (default: gaussian)")
    p.add_argument("--init", type=Path, help="checkpoint to start from, instead of random weights")
    p.add_argument("--steps", type=int, default=100_000, help="stop after this many steps (default: 100000)")
    p.add_argument("--minutes", type=float, help="stop after this long; the learning rate follows the clock")
    p.add_argument(
        "--sampling",
        choices=["setups", "paper", "video", "static"],
        default="setups",
        help="views of a sample: as the evaluation setups (default), of 36 at random, front video, of one frame",
    )
    p.add_argument(
        "--static", dest="sampling", action="store_const", const="static", help="short for --sampling static"
    )
    p.add_argument("--views", type=int, help="input views of a sample (default: 24; paper 12, video 27, static 4)")
    p.add_argument("--targets", type=int, help="supervision views of a sample (default: 8; paper 24, static 4)")
    p.add_argument("--mix", default="200:50:1", help="weights of much moving : moving : still clips, or uniform")
    p.add_argument("--shrink", type=int, default=1, help="train at 1/N of the rendered size (curriculum; default: 1)")
    p.add_argument("--rate", type=float, default=4e-4, help="peak learning rate (default: 4e-4)")
    p.add_argument("--warmup", type=int, default=100, help="steps of linear warm-up (default: 100; the paper's: 2000)")
    p.add_argument("--optimiser", choices=["adamw", "muon"], default="adamw", help="muon: for the blocks' matrices")
    p.add_argument("--accumulate", type=int, default=1, help="samples per step (default: 1)")
    p.add_argument("--perceptual", type=float, default=0.5, help="weight of the VGG-19 loss, if there are weights")
    p.add_argument("--geometric", type=float, default=0.0, help="weight of the geometric loss, for RGB sources")
    p.add_argument("--opacity", type=float, default=0.0, help="weight of the mean opacity (default: 0)")
    p.add_argument("--bf16", action="store_true", help="run the transformer in bfloat16")
    p.add_argument("--checkpointing", action="store_true", help="keep less memory, compute blocks twice")
    p.add_argument("--device", default="cpu", help="cpu or cuda (default: cpu)")
    p.add_argument("--cache", type=Path, default=Path("data/cache"), help="where packed clips are kept")
    p.add_argument("--seed", type=int, default=0)


def train(args: argparse.Namespace) -> int:
    """Train a network on rendered Sequences; stops by --steps or --minutes, and goes on where it stood."""
    from .model.training.trainer import run

    return run(args)


def reconstruct_arguments(p: argparse.ArgumentParser) -> None:
    p.add_argument("sequence", type=Path, help="folder that `timesplat render` wrote (or another in its format)")
    p.add_argument("--out", type=Path, required=True, help=".ply to write")
    p.add_argument("--method", default="guided", help="lift, guided, rgb, sweep, predicted, 4dgs (default: guided)")
    p.add_argument("--seconds", type=float, default=10.0, help="for methods that fit the scene: 4dgs (default: 10)")
    p.add_argument("--refine", type=float, default=0.0, help="seconds of fitting the result to the views (default: 0)")
    p.add_argument("--budget", help="most Gaussians: a number, a share of those predicted such as 10%%, or auto: as "
                   "many as the scene needs; fits them for --refine seconds, or 5")  # fmt: skip
    p.add_argument("--max-loss", type=float, default=0.1, help="dB that --budget auto may lose (default: 0.1)")
    p.add_argument("--rig", help="use only the views of this rig")
    p.add_argument("--checkpoint", type=Path, help="weights in place of the shipped ones")
    p.add_argument("--device", default="cpu", help="cpu or cuda (default: cpu)")


def reconstruct(args: argparse.Namespace) -> int:
    """Reconstruct a Sequence as one 4D Gaussian asset (.ply)."""
    import time

    from .datagen.sequence import read_sequence
    from .model.fitting.budget import parse
    from .model.fitting.refine import check_seconds
    from .model.geometry.coverage import SURFACES, coverage
    from .model.io.ply import write_ply
    from .model.reconstruct import NEEDS_PASSES, clip_of
    from .model.reconstruct import reconstruct as run
    from .model.views import load_views

    start = time.perf_counter()
    check_seconds(args.refine)
    if args.budget:
        parse(args.budget)
    seq = read_sequence(args.sequence)
    rigs = sorted({v.rig for v in seq.views})
    if args.rig and args.rig not in rigs:
        raise InputError(f"{args.sequence}: no rig {args.rig}; it has {', '.join(rigs)}.")
    indices = seq.select(rig=args.rig) if args.rig else [i for i, v in enumerate(seq.views) if v.rig != "target"]
    g = run(
        seq,
        args.method,
        indices,
        args.device,
        args.checkpoint,
        seconds=args.seconds,
        refine=args.refine,
        budget=args.budget,
        max_loss=args.max_loss,
    )
    write_ply(args.out, g.to_asset(clip_of(seq)))
    print(f"{args.out}: {len(g)} Gaussians from {len(indices)} views in {time.perf_counter() - start:.1f} s")
    if args.method in SURFACES and not (args.refine or args.budget):
        share, _ = coverage(g, load_views(seq, indices, args.method in NEEDS_PASSES))
        print(f"coverage {share:.0%}" + ("" if share > 0.99 else ": what no camera saw is left open"))
    return 0


# ---------------------------------------------------------------- export, extension


def export_arguments(p: argparse.ArgumentParser) -> None:
    p.add_argument("asset", type=Path, help=".ply that `timesplat reconstruct` wrote, or another "
                   "file of Gaussians: 3DGS .ply, .splat, .spz, USD; or a folder with a .ply a frame")  # fmt: skip
    p.add_argument("out", type=Path, nargs="?", help=".usdc, .usda, .usdz, .ply, .blend to write; .splat with --frame")
    p.add_argument("--mode", choices=["splats", "points", "frames"], default="splats", help="USD: splats that old "
                   "readers take as points (default), points alone, or splats sampled at every frame")  # fmt: skip
    p.add_argument("--half", action="store_true", help="USD: half precision")
    p.add_argument("--original", type=Path, help="USD: file of the original object, for a variant set")
    p.add_argument("--original-start", type=float, help="its frame at the clip's first frame (default: the same frame)")
    p.add_argument("--check", action="store_true", help="USD: exit with 1 if the validator complains")
    p.add_argument("--frame", type=float, help="write this moment alone, as 3DGS .ply or .splat")
    p.add_argument("--sequence", type=Path, metavar="FOLDER", help="write a 3DGS .ply a frame into a new folder")


def export(args: argparse.Namespace) -> int:
    """Export an asset: USD (Gaussian splats that older readers take as points), 3DGS .ply slices, or a .blend."""
    import tempfile

    from .model.io.files import WRITABLE, read_asset, write_asset
    from .model.io.slices import write_slices
    from .model.io.usd_check import check_usd
    from .model.io.usd_stage import USD_SUFFIXES

    suffix = args.out.suffix.lower() if args.out else ""
    usd = suffix in USD_SUFFIXES
    if (args.out is None) == (args.sequence is None):
        raise InputError("export: name one file to write, or a folder by --sequence.")
    if not usd and (args.mode != "splats" or args.half or args.original or args.check):
        raise InputError(f"{args.out or args.sequence}: --mode, --half, --original and --check are for USD; drop them.")
    if args.frame is not None and (usd or args.sequence):
        raise InputError("export: --frame is for one .ply or .splat; drop it.")
    loaded = read_asset(args.asset)
    asset, count = loaded.asset, len(loaded.asset)
    if loaded.note:
        print(f"{args.asset}: {loaded.note}")
    if loaded.up != "Z":
        print(f"{args.asset}: {loaded.up} is up in it, as far as is known; nothing is turned, Z is taken for up")
    if loaded.motion is not None and not usd:
        print(f"{args.asset}: it moves as a whole; what is written stands where that starts, USD would keep it")
    if args.sequence:
        print(f"{args.sequence}: {write_slices(args.sequence, asset, args.asset.stem)} files")
        return 0
    if suffix == ".blend" and args.frame is None:
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
            ply = Path(folder) / f"{args.asset.stem}.ply"
            write_asset(ply, asset)
            save_blend(ply, args.out)
    elif suffix not in WRITABLE and args.frame is None:
        raise InputError(f"{args.out}: cannot write that; choose .usdc, .usda, .usdz, .ply or .blend.")
    else:
        options = {}
        if usd:
            options = {"mode": args.mode, "half": args.half, "motion": loaded.motion}
            options |= {"original": args.original, "original_start": args.original_start}
        count = write_asset(args.out, asset, frame=args.frame, **options)
    print(f"{args.out}: {count} Gaussians, {args.out.stat().st_size / 1e6:.1f} MB")
    complaints = check_usd(args.out) if usd else []
    for complaint in complaints:
        print(f"  {complaint}")
    if usd and not complaints:
        print("  the validator has no complaints")
    return 1 if args.check and complaints else 0


def save_blend(asset: Path, out: Path) -> None:
    """The asset as a .blend that plays without the add-on; Blender runs in a process of its own."""
    import subprocess

    command = [sys.executable, "-m", "timesplat.addon.display", str(asset), str(out)]
    done = subprocess.run(command, capture_output=True, encoding="utf-8", errors="replace")
    if done.returncode:
        reason = (done.stderr.strip() or done.stdout.strip() or "Blender stopped").splitlines()[-1]
        raise InputError(f"{out}: the .blend was not written: {reason}")


# ---------------------------------------------------------------- evaluate, demo


def evaluate_arguments(p: argparse.ArgumentParser) -> None:
    p.add_argument("assets", nargs="+", help="animated files, zoo:SEED, rendered Sequences, or folders of either")
    p.add_argument("--setup", default="alternating", help="comma-separated: alternating, interpolation, rotating, "
                   "random (all: these four), video, canonical, random-N, views-N (default: alternating)")  # fmt: skip
    p.add_argument("--size", default="128", help="comma-separated pixels, multiples of 8 (default: 128); rendered "
                   "at the largest, the others are whole fractions of it")  # fmt: skip
    p.add_argument("--protocol", choices=["paper"], help="score four canonical and a random view a frame also for one "
                   "setup and size, not the held-out views alone")  # fmt: skip
    p.add_argument("--stride", default="1", help="score every Nth frame; one number, or one for each size (default: 1)")
    p.add_argument("--samples", type=int, default=16, help="Cycles samples (default: 16)")
    p.add_argument("--methods", default="white,hull,lift,guided,sweep,predicted,rgb", help="comma-separated")
    p.add_argument("--checkpoint", type=Path, help="weights for the one network method named")
    p.add_argument("--out", type=Path, required=True, help="folder for renders, metrics.json, tables.md, tables.csv")
    p.add_argument("--jobs", type=int, default=2, help="processes, one core each (default: 2)")
    p.add_argument("--seconds", type=float, default=10.0, help="for methods that fit a scene (default: 10)")
    p.add_argument("--limit", type=float, help="seconds after which no reconstruction is started; then the tables "
                   "are those of what there is, and the same command goes on")  # fmt: skip
    p.add_argument("--no-lpips", dest="lpips", action="store_false", help="leave LPIPS out even if it has weights")
    p.add_argument("--seed", type=int, default=0)


def evaluate(args: argparse.Namespace) -> int:
    """Render what is not yet rendered, reconstruct with each method, score, write tables in the paper's layout."""
    import time

    from .datagen.render import Settings
    from .datagen.rigs import SETUPS
    from .evaluation.evaluate import evaluate_folders, find_sequences
    from .evaluation.lpips import HINT, LPIPS
    from .evaluation.protocol import TABLE, check_setup

    methods, sizes, stride = check_methods(args.methods), numbers("--size", args.size), numbers("--stride", args.stride)
    names = ",".join(TABLE) if args.setup == "all" else args.setup
    setups = list(dict.fromkeys(check_setup(s.strip()) for s in names.split(",")))
    if len(stride) not in (1, len(sizes)):
        raise InputError(f"--stride {args.stride}: give one number, or one for each of the {len(sizes)} sizes.")
    if args.seconds <= 0:
        raise InputError(f"--seconds {args.seconds:g}: give more than 0.")
    if args.jobs < 1:
        raise InputError(f"--jobs {args.jobs}: give 1 or more.")
    several = len(setups) > 1 or len(sizes) > 1 or args.protocol == "paper"
    rig = "evaluation" if several or setups[0] not in SETUPS else setups[0]
    settings = Settings(rig=rig, targets=1, size=max(sizes), samples=args.samples, seed=args.seed)

    sequences, others = find_sequences(args.assets)
    rendered = bool(sequences)
    failures = render_into(args.out / "renders" / rig, others, settings, args.jobs, sequences)
    if not sequences:
        raise InputError(f"{args.assets[0]}: nothing to evaluate; none of the assets could be rendered.")
    if args.lpips and not LPIPS.find():
        print(HINT, file=sys.stderr)
    evaluate_folders(
        sequences,
        methods,
        args.out,
        args.checkpoint,
        command=args.typed,
        setups=tuple(setups),
        sizes=tuple(sorted(sizes)),
        stride=tuple(n for _, n in sorted(zip(sizes, stride * len(sizes), strict=False))),
        lpips=args.lpips,
        seconds=args.seconds,
        deadline=time.time() + args.limit if args.limit is not None else float("inf"),
        jobs=min(args.jobs, len(setups) * len(sequences)) if several or rendered else 1,
    )
    return 2 if failures else 0


def render_into(folder: Path, assets: list[str], settings, jobs: int, sequences: dict) -> list[str]:
    """Renders what is not yet rendered, adds it to `sequences` by name, returns what failed."""
    from tqdm import tqdm

    from .datagen.render import render_assets
    from .datagen.sequence import read_sequence

    if not assets:
        return []
    with tqdm(total=0, desc="rendering", unit="object", disable=None) as bar:

        def progress(done: int, total: int, images: int) -> None:
            bar.total, bar.n = total, done
            bar.refresh()

        made, failures = render_assets(assets, folder, settings, jobs=jobs, report=bar.write, progress=progress)
    sequences |= {f.parent.name: read_sequence(f) for f in sorted(made)}
    return failures


def numbers(option: str, text: str) -> list[int]:
    """Comma-separated whole numbers above 0. Raises InputError."""
    parts = [p.strip() for p in text.split(",")]
    if not all(p.isdigit() and int(p) > 0 for p in parts):
        raise InputError(f"{option} {text}: give numbers above 0, with commas between them.")
    return [int(p) for p in parts]


def check_methods(text: str) -> list[str]:
    """A comma-separated list of methods. Raises InputError naming the unknown one and those there are."""
    from .evaluation.evaluate import parse_method

    methods = [m.strip() for m in text.split(",") if m.strip()]
    for m in methods:
        parse_method(m)
    return methods


def bench_arguments(p: argparse.ArgumentParser) -> None:
    p.add_argument("assets", nargs="*", help="animated files, zoo:SEED, Sequences rendered with --rig evaluation "
                   "--targets 1, or folders of either (default: 6 procedural objects no checkpoint saw)")  # fmt: skip
    p.add_argument("--out", type=Path, default=Path("out/bench"), help="folder to write (default: out/bench); "
                   "another one after changing the code, as rows are kept")  # fmt: skip
    p.add_argument("--objects", type=int, help="only the first N objects")
    p.add_argument("--quick", action="store_true", help="2 objects unless --objects says, no fit of more than 3 "
                   "seconds, no chart of the renderer: some 4 minutes")  # fmt: skip
    p.add_argument("--methods", help="only these ways, at the centre: comma-separated, written as in bench.csv, for "
                   "example guided,4dgs:10,rgb+refine:3")  # fmt: skip
    p.add_argument("--renderer", action="store_true", help="only the chart of the renderer: some 2 minutes")
    p.add_argument("--size", type=int, default=128, help="pixels to render at; 256 adds that size (default: 128)")
    p.add_argument("--jobs", type=int, default=2, help="processes, one core each (default: 2)")
    p.add_argument("--limit", type=float, help="seconds after which nothing is started; the charts are then of what "
                   "all objects have, and the same command goes on")  # fmt: skip
    p.add_argument("--draw", type=Path, metavar="CSV", help="only draw again, from a bench.csv")


def bench(args: argparse.Namespace) -> int:
    """Speed against accuracy: every way from posed images to novel views, on held-out objects, in some 25 minutes
    on two cores. Writes into --out: bench.csv (a row for each object and way), bench.md (means, machine, what is
    on the Pareto frontiers) and bench-*.png and .svg: quality against seconds and against size, Gaussian budgets,
    numbers of views and sizes, renderer samples. A run that was stopped goes on where it was."""
    from .evaluation.bench_command import run

    return run(args, render_into)


def demo_arguments(p: argparse.ArgumentParser) -> None:
    p.add_argument(
        "asset", nargs="?", help="an animated file, or zoo:SEED (default: a procedural object no checkpoint saw)"
    )
    p.add_argument("--out", type=Path, default=Path("out/demo"), help="folder to write (default: out/demo)")
    p.add_argument("--size", type=int, default=128, help="pixels, a multiple of 8 (default: 128)")
    p.add_argument("--samples", type=int, default=32, help="Cycles samples (default: 32)")


def demo(args: argparse.Namespace) -> int:
    """Render an animated object, reconstruct it several ways, export it, and lay everything side by side."""
    from .evaluation.demo import run

    return run(args, save_blend)


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
    "render": (render_arguments, render, "assets to Sequences (Blender)"),
    "reconstruct": (reconstruct_arguments, reconstruct, "a Sequence to a 4D Gaussian asset"),
    "export": (export_arguments, export, "an asset to USD or .blend"),
    "evaluate": (evaluate_arguments, evaluate, "score methods on held-out views"),
    "bench": (bench_arguments, bench, "speed against accuracy, in charts"),
    "train": (train_arguments, train, "train a network on Sequences"),
    "extension": (extension_arguments, extension, "build the Blender extension"),
}

if __name__ == "__main__":
    sys.exit(main())
