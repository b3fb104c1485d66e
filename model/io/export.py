# SPDX-License-Identifier: GPL-3.0-or-later
"""`timesplat export` and `timesplat view`: assets, and others' files of Gaussians, as files of other programs, as a
page that plays them, and in the browser."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ...datagen.sequence import InputError

if TYPE_CHECKING:
    from .asset import Asset, LoadedAsset

FILMS = (".mp4", ".webp", ".gif", ".mov")  # which people may ask for here


def add_export_arguments(p: argparse.ArgumentParser) -> None:
    from .files import FRAME_SUFFIXES, WRITABLE, named
    from .slice_formats import SLICE_FORMATS

    add_asset_arguments(p)
    p.add_argument("out", type=Path, nargs="?", help=f"{named(WRITABLE)} or .blend to write (.html: a page that "
                   f"plays it); with --frame {named(SLICE_FORMATS)}")  # fmt: skip
    p.add_argument("--mode", choices=["splats", "points", "frames"], default="splats", help="USD: splats that old "
                   "readers take as points (default), points alone, or splats sampled at every frame")  # fmt: skip
    p.add_argument("--half", action="store_true", help="USD: half precision")
    p.add_argument("--original", type=Path, help="USD: file of the original object, for a variant set")
    p.add_argument("--original-start", type=float, help="its frame at the clip's first frame (default: the same frame)")
    p.add_argument("--pieces", action="store_true", help="write straight 4D Gaussians in place of tracks, for readers "
                   "that know no paths")  # fmt: skip
    p.add_argument("--check", action="store_true", help="USD: exit with 1 if the validator complains")
    p.add_argument("--frame", type=float, help=f"write this moment alone, as {named(SLICE_FORMATS)}")
    p.add_argument("--sequence", type=Path, metavar="FOLDER", help="write a file a frame into a new folder")
    p.add_argument("--suffix", choices=SLICE_FORMATS, help="of --sequence's files (default: .ply, as 3DGS has it); "
                   f"folders of {named(FRAME_SUFFIXES)} are read again")  # fmt: skip


def export(args: argparse.Namespace) -> int:
    """`timesplat export`: 0, or 1 where the validator complains and --check was given. Raises InputError."""
    import tempfile

    from .files import STRAIGHT, WRITABLE, named, write_asset
    from .slice_formats import SLICE_FORMATS
    from .slices import write_slices
    from .usd_check import check_usd
    from .usd_stage import USD_SUFFIXES

    suffix = args.out.suffix.lower() if args.out else ""
    usd = suffix in USD_SUFFIXES
    if (args.out is None) == (args.sequence is None):
        raise InputError("export: name one file to write, or a folder by --sequence.")
    if not usd and (args.mode != "splats" or args.half or args.original or args.check):
        raise InputError(f"{args.out or args.sequence}: --mode, --half, --original and --check are for USD; drop them.")
    if args.frame is not None and (usd or args.sequence):
        raise InputError("export: --frame is for one moment's file, as .ply or .splat; drop it.")
    if args.suffix and not args.sequence:
        raise InputError("export: --suffix is for the files of --sequence; drop it, or name a folder.")
    if args.pieces and (args.sequence or args.frame is not None):
        raise InputError("export: --pieces is for what has time, not for moments; drop it.")
    loaded = _read(args.asset, args.up)
    asset, count = loaded.asset, len(loaded.asset)
    if loaded.motion is not None and not usd:
        print(f"{args.asset}: it moves as a whole; what is written stands where that starts, USD would keep it")
    if args.sequence:
        print(f"{args.sequence}: {write_slices(args.sequence, asset, args.asset.stem, args.suffix or '.ply')} files")
        return 0
    if suffix == ".blend" and args.frame is None:
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
            ply = Path(folder) / f"{args.asset.stem}.ply"
            count = write_asset(ply, asset, pieces=args.pieces)
            save_blend(ply, args.out)
    elif suffix not in WRITABLE and args.frame is None and suffix in SLICE_FORMATS:
        raise InputError(f"{args.out}: {suffix} holds one moment; say which by --frame.")
    elif suffix in FILMS:
        raise InputError(f"{args.out}: films are made by `timesplat video`; say that in place of export.")
    elif suffix not in WRITABLE and args.frame is None:
        raise InputError(f"{args.out}: cannot write that; choose {named(WRITABLE)} or .blend.")
    else:
        options = {}
        if usd:
            options = {"mode": args.mode, "half": args.half, "motion": loaded.motion}
            options |= {"original": args.original, "original_start": args.original_start}
        count = write_asset(args.out, asset, frame=args.frame, pieces=args.pieces, **options)
    if suffix in STRAIGHT and asset.paths is not None:
        print(f"{args.out}: it knows no paths, so that {len(asset)} Gaussians on paths are {count} straight ones")
    print(f"{args.out}: {count} Gaussians, {args.out.stat().st_size / 1e6:.1f} MB")
    complaints = check_usd(args.out) if usd else []
    for complaint in complaints:
        print(f"  {complaint}")
    if usd and not complaints:
        print("  the validator has no complaints")
    return 1 if args.check and complaints else 0


def _read(path: Path, up: str | None) -> LoadedAsset:
    """What a file holds, turned so that Z is up in place of `up`; what is to be said of it is printed."""
    from .files import read_asset, upright

    loaded = read_asset(path)
    if loaded.note:
        print(f"{path}: {loaded.note}")
    if loaded.up != "Z" and not up:
        print(f"{path}: {loaded.up} is up in it, as far as is known; it is turned so that Z is. --up says otherwise")
    return replace(loaded, asset=upright(loaded, up), up="Z")


def read_upright(path: Path, up: str | None) -> Asset:
    """What a file holds, with Z up; what is to be said of it is printed. Raises InputError."""
    return _read(path, up).asset


def add_asset_arguments(p: argparse.ArgumentParser) -> None:
    """The file to read, and what is up in it."""
    from .files import FRAME_SUFFIXES, READABLE, named

    p.add_argument("asset", type=Path, help=f"what `timesplat reconstruct` wrote, or another file of Gaussians: "
                   f"{named(READABLE)}; or a folder of {named(FRAME_SUFFIXES)}, one a frame")  # fmt: skip
    p.add_argument("--up", choices=["Z", "Y", "-Y"], help="what points up in the file (default: Z in Timesplat's own "
                   "and in USD, what a .4dgs says, Y in .spz, -Y in other .ply, .splat and .sog, which say nothing, as "
                   "in captures that 3DGS is trained on)")  # fmt: skip


def save_blend(asset: Path, out: Path) -> None:
    """The asset as a .blend that plays without the add-on; Blender runs in a process of its own."""
    import subprocess

    command = [sys.executable, "-m", "timesplat.addon.asset.blend_file", str(asset), str(out)]
    done = subprocess.run(command, capture_output=True, encoding="utf-8", errors="replace")
    if done.returncode:
        reason = (done.stderr.strip() or done.stdout.strip() or "Blender stopped").splitlines()[-1]
        raise InputError(f"{out}: the .blend was not written: {reason}")


def add_view_arguments(p: argparse.ArgumentParser) -> None:
    add_asset_arguments(p)


def view(args: argparse.Namespace) -> int:
    """`timesplat view`: 0. Raises InputError."""
    import tempfile
    import webbrowser

    from .files import write_asset

    asset = read_upright(args.asset, args.up)
    page = Path(tempfile.mkdtemp(prefix="timesplat-")) / f"{args.asset.resolve().stem}.html"
    write_asset(page, asset)
    print(f"{page}: {len(asset)} Gaussians, {page.stat().st_size / 1e6:.1f} MB")
    if not webbrowser.open(page.as_uri()):
        print("no browser was found; open the page in one")
    return 0
