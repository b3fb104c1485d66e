# SPDX-License-Identifier: GPL-3.0-or-later
"""Sizes and seconds of an asset's USD files, as a table: `python benchmarks/usd.py ASSET.ply [--count N]`.

For every mode, in full and half precision, as .usdc (a .usdz is a few hundred bytes larger, a .usda is text).
Processor seconds of one process, the least of three calls, import of pxr not counted.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from timesplat.benchmarks.timing import least
from timesplat.evaluation.provenance import machine
from timesplat.model.io.asset import ARRAYS, Asset
from timesplat.model.io.ply import read_ply
from timesplat.model.io.usd_check import check_usd
from timesplat.model.io.usd_read import read_usd
from timesplat.model.io.usd_write import MODES, write_usd


def rows(asset: Asset) -> list[str]:
    lines = ["| mode | precision | MB | write | check | read back |", "|---|---|---|---|---|---|"]
    with tempfile.TemporaryDirectory() as folder:
        for mode in MODES:
            for half in (False, True):
                path = Path(folder) / f"{mode}{half}.usdc"
                write = least(lambda path=path, mode=mode, half=half: write_usd(path, asset, mode=mode, half=half))
                if complaints := check_usd(path):
                    raise SystemExit("\n".join(complaints))
                check, read = least(lambda path=path: check_usd(path)), least(lambda path=path: read_usd(path))
                lines.append(
                    f"| {mode} | {'half' if half else 'full'} | {path.stat().st_size / 1e6:.1f} "
                    f"| {write:.2f} s | {check:.2f} s | {read:.2f} s |"
                )
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("asset", type=Path)
    parser.add_argument("--count", type=int, help="take so many of its Gaussians, at random (seed 0)")
    args = parser.parse_args()
    asset = read_ply(args.asset)
    if args.count:
        some = np.sort(np.random.default_rng(0).permutation(len(asset))[: args.count])
        asset = replace(asset, **{k: getattr(asset, k)[some] for k in ARRAYS})
    print(f"{len(asset)} Gaussians, {len(asset.clip.frames)} frames; {machine()['cpu']}\n")
    print("\n".join(rows(asset)))


if __name__ == "__main__":
    main()
