# SPDX-License-Identifier: GPL-3.0-or-later
"""`timesplat <command>`: thin, one function a command. Heavy imports happen inside the commands."""

from __future__ import annotations

import argparse
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


def main(argv: list[str] | None = None) -> int:
    """Runs a command and returns its exit code: 0, or 2 where the input cannot be used."""
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
    args = parser.parse_args(argv)
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
    p.add_argument("data", nargs="+", type=Path, help="folders of Sequences rendered with passes")
    p.add_argument("--out", type=Path, required=True, help="run folder; training goes on where it stands")
    p.add_argument("--preset", choices=["tiny", "small", "base", "large"], default="tiny", help="size (default: tiny)")
    p.add_argument("--head", choices=["paper", "kinematic"], default="kinematic", help="20 or 19 outputs a pixel")
    p.add_argument("--source", choices=["given", "sweep", "predicted"], default="given", help="where depth comes from")
    p.add_argument("--depth-range", choices=["paper", "centred"], default="paper", help="for --source predicted")
    p.add_argument("--time", choices=["free", "aligned"], default="free", help="of a pixel: free, or its frame's")
    p.add_argument("--free", type=int, default=0, help="free Gaussians beside the pixels' (default: 0)")
    p.add_argument("--motion", choices=["gaussian", "hexplane"], default="gaussian", help="what moves Gaussians")
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
    from .model.train import run

    return run(args)


def reconstruct_arguments(p: argparse.ArgumentParser) -> None:
    p.add_argument("sequence", type=Path, help="folder that `timesplat render` wrote (or another in its format)")
    p.add_argument("--out", type=Path, required=True, help=".ply to write")
    p.add_argument("--method", default="guided", help="lift, guided, rgb, sweep, predicted (default: guided)")
    p.add_argument("--rig", help="use only the views of this rig")
    p.add_argument("--checkpoint", type=Path, help="weights in place of the shipped ones")
    p.add_argument("--device", default="cpu", help="cpu or cuda (default: cpu)")


def reconstruct(args: argparse.Namespace) -> int:
    """Reconstruct a Sequence as one 4D Gaussian asset (.ply)."""
    import time

    from .datagen.sequence import read_sequence
    from .model.asset import write_ply
    from .model.reconstruct import clip_of
    from .model.reconstruct import reconstruct as run

    start = time.perf_counter()
    seq = read_sequence(args.sequence)
    rigs = sorted({v.rig for v in seq.views})
    if args.rig and args.rig not in rigs:
        raise InputError(f"{args.sequence}: no rig {args.rig}; it has {', '.join(rigs)}.")
    indices = seq.select(rig=args.rig) if args.rig else [i for i, v in enumerate(seq.views) if v.rig != "target"]
    g = run(seq, args.method, indices, args.device, args.checkpoint)
    write_ply(args.out, g.to_asset(clip_of(seq)))
    print(f"{args.out}: {len(g)} Gaussians from {len(indices)} views in {time.perf_counter() - start:.1f} s")
    return 0


# ---------------------------------------------------------------- export, extension


def export_arguments(p: argparse.ArgumentParser) -> None:
    p.add_argument("asset", type=Path, help=".ply that `timesplat reconstruct` wrote")
    p.add_argument("out", type=Path, help=".usdc, .usda, .usdz or .blend to write")
    p.add_argument("--points-only", action="store_true", help="USD: points, without the Gaussian splat schema")
    p.add_argument("--half", action="store_true", help="USD: half precision")


def export(args: argparse.Namespace) -> int:
    """Export an asset to USD (Gaussian splat prim that older readers take as points) or to a .blend."""
    from .model.asset import read_ply

    asset = read_ply(args.asset)
    suffix = args.out.suffix.lower()
    if suffix in (".usd", ".usda", ".usdc", ".usdz"):
        from .model.usd import write_usd

        write_usd(args.out, asset, points_only=args.points_only, half=args.half)
    elif suffix == ".blend":
        save_blend(args.asset, args.out)
    else:
        raise InputError(f"{args.out}: cannot write {suffix or 'that'}; choose .usdc, .usda, .usdz or .blend.")
    print(f"{args.out}: {len(asset)} Gaussians, {args.out.stat().st_size / 1e6:.1f} MB")
    return 0


def save_blend(asset: Path, out: Path) -> None:
    """The asset as a .blend that plays without the add-on; Blender runs in a process of its own."""
    import subprocess

    command = [sys.executable, "-m", "timesplat.addon.display", str(asset), str(out)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        reason = (done.stderr.strip() or done.stdout.strip() or "Blender stopped").splitlines()[-1]
        raise InputError(f"{out}: the .blend was not written: {reason}")


# ---------------------------------------------------------------- evaluate, demo


def evaluate_arguments(p: argparse.ArgumentParser) -> None:
    p.add_argument("assets", nargs="+", help="animated files, folders of them, or zoo:SEED")
    p.add_argument("--setup", choices=["alternating", "interpolation", "rotating", "random"], default="alternating")
    p.add_argument("--size", type=int, default=128, help="pixels, a multiple of 8 (default: 128)")
    p.add_argument("--samples", type=int, default=16, help="Cycles samples (default: 16)")
    p.add_argument("--methods", default="white,hull,lift,guided,sweep,predicted,rgb", help="comma-separated")
    p.add_argument("--checkpoint", type=Path, help="weights for the one network method named")
    p.add_argument("--out", type=Path, required=True, help="folder for renders, metrics.json and metrics.md")
    p.add_argument("--jobs", type=int, default=2, help="renders in parallel (default: 2)")
    p.add_argument("--seed", type=int, default=0)


def evaluate(args: argparse.Namespace) -> int:
    """Render what is not yet rendered, reconstruct with each method, score held-out views."""
    from tqdm import tqdm

    from .datagen.render import Settings, render_assets
    from .datagen.sequence import read_sequence
    from .model.evaluate import evaluate_folders

    methods = check_methods(args.methods)
    settings = Settings(rig=args.setup, targets=1, size=args.size, samples=args.samples, seed=args.seed)
    with tqdm(total=0, desc="rendering", unit="object", disable=None) as bar:

        def progress(done: int, total: int, images: int) -> None:
            bar.total, bar.n = total, done
            bar.refresh()

        folders, failures = render_assets(
            args.assets,
            args.out / "renders" / args.setup,
            settings,
            jobs=args.jobs,
            report=bar.write,
            progress=progress,
        )
    if not folders:
        raise InputError(f"{args.assets[0]}: nothing to evaluate; none of the assets could be rendered.")
    evaluate_folders({f.parent.name: read_sequence(f) for f in sorted(folders)}, methods, args.out, args.checkpoint)
    return 2 if failures else 0


def check_methods(text: str) -> list[str]:
    """A comma-separated list of methods. Raises InputError naming the unknown one and those there are."""
    from .model.reconstruct import METHODS

    methods = [m.strip() for m in text.split(",") if m.strip()]
    for m in methods:
        if m not in METHODS:
            raise InputError(f"{m}: no such method; choose from {', '.join(METHODS)}.")
    return methods


def demo_arguments(p: argparse.ArgumentParser) -> None:
    p.add_argument(
        "asset", nargs="?", help="an animated file, or zoo:SEED (default: a procedural object no checkpoint saw)"
    )
    p.add_argument("--out", type=Path, default=Path("out/demo"), help="folder to write (default: out/demo)")
    p.add_argument("--size", type=int, default=128, help="pixels, a multiple of 8 (default: 128)")
    p.add_argument("--samples", type=int, default=32, help="Cycles samples (default: 32)")


def demo(args: argparse.Namespace) -> int:
    """Render an animated object, reconstruct it three ways, export it, and lay everything side by side."""
    from .demo import run

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
    "train": (train_arguments, train, "train a network on Sequences"),
    "extension": (extension_arguments, extension, "build the Blender extension"),
}

if __name__ == "__main__":
    sys.exit(main())
