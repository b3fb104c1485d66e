# SPDX-License-Identifier: GPL-3.0-or-later
"""Our renderer against the field's recipe, at equal PSNR: `timesplat bench --recipe`, as recipe.md and a chart.

Every way of `benchmarks.recipe` renders the same views of the same objects, a process each. PSNR is to pictures of 512
samples over white. What ours costs at a recipe's PSNR lies between two of its numbers of samples: log seconds over dB
is taken as straight there. An object has IMAGES pictures, so that what is done once an object counts as it does in use.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue

import numpy as np
from PIL import Image
from tqdm import tqdm

from ..benchmarks.recipe import SIZE, TRUTH, WAYS
from ..datagen.render_job import list_assets
from ..datagen.render_pool import cores
from ..datagen.sequence import InputError, read_sequence
from .figures import COLOURS, MARKERS, panels, save, write_table
from .labels import plain
from .provenance import Provenance, machine

OBJECTS = ("zoo:1000102", "zoo:1000100")
IMAGES = 144  # of an object: 24 frames, six cameras
QUICK_SIZE = 128
TOLERANCE = 0.2  # dB within which two PSNR are one
STAGES = ("scene", "samples", "denoising", "EXR of Blender", "PNG", "EXR")


def compare(assets: Sequence[str], out: Path, *, quick: bool = False, jobs: int = 1, command: str = "") -> str:
    """Measures what is not yet in `out`/.recipe, writes recipe.md, recipe.csv, recipe.png and .svg -> the Markdown.
    assets: files or "zoo:SEED", by default two of the zoo; quick: the first of them, pictures of 128². Raises
    InputError for one that cannot be rendered."""
    size = QUICK_SIZE if quick else SIZE
    listed = list_assets(list(assets) or list(OBJECTS))[: 1 if quick else None]
    work = [(a.path, a.name, way, out / ".recipe" / a.name / f"{size}" / way) for a in listed for way in WAYS]
    free: SimpleQueue[int] = SimpleQueue()
    for i in range(jobs):
        free.put(cores()[i % len(cores())])

    def run(asset: str, way: str, folder: Path) -> None:
        if not (folder / "result.json").is_file():
            core = free.get()
            try:
                _measure(asset, way, size, folder, core)
            finally:
                free.put(core)

    with ThreadPoolExecutor(jobs) as pool, tqdm(total=len(work), desc="recipe", unit="way", disable=None) as bar:
        waiting = [pool.submit(run, asset, way, folder) for asset, _, way, folder in work]
        try:
            for done in waiting:
                done.result()
                bar.update()
        finally:
            pool.shutdown(cancel_futures=True)
    rows = [
        json.loads((folder / "result.json").read_text())
        | {"object": name, "way": way, "psnr": psnr(folder, folder.with_name(TRUTH))}
        for _, name, way, folder in work
        if way != TRUTH
    ]
    made_by = Provenance.of(command)
    draw(out / "recipe", rows, made_by.caption)
    return _page(out / "recipe", rows, size, made_by)


def _measure(asset: str, way: str, size: int, folder: Path, core: int) -> None:
    words = [sys.executable, "-m", "timesplat.benchmarks.recipe", asset, way, str(size), str(folder), str(core)]
    done = subprocess.run(words, capture_output=True, text=True)
    if done.returncode:
        last = (done.stderr.strip() or done.stdout.strip() or "no word").splitlines()[-1]
        raise InputError(f"{asset}: {way} could not be measured: {last}")


# ---------------------------------------------------------------- figures


def pictures(folder: Path) -> np.ndarray:
    """(V,H,W,3) over white of what `benchmarks.recipe` left in a folder."""
    if (folder / "sequence").is_dir():
        seq = read_sequence(folder / "sequence")
        rgba = np.stack([seq.load_image(i) for i in range(len(seq.views))])
    else:
        rgba = np.stack([np.asarray(Image.open(f)) for f in sorted(folder.glob("[0-9]*.png"))])
    rgba = rgba.astype(np.float64) / 255
    return rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:]


def psnr(folder: Path, truth: Path) -> float:
    """Mean over the views, dB."""
    error = np.square(pictures(folder) - pictures(truth)).mean((1, 2, 3))
    return float(np.mean(-10 * np.log10(np.maximum(error, 1e-10))))


def seconds_an_image(row: dict) -> float:
    """Of an object of IMAGES pictures, all that is done once included."""
    once = row["total"] - row["images"] * row["image"]
    return once / IMAGES + row["image"]


def ours_at(rows: list[dict], quality: float) -> float | None:
    """Seconds an image of ours at a PSNR; None where it is above all that were measured. Where it is below them, those
    of the fewest samples."""
    ours = sorted((r["psnr"], seconds_an_image(r)) for r in rows if WAYS[r["way"]].ours)
    x, y = zip(*ours, strict=True)
    if quality > x[-1] + TOLERANCE:
        return None
    return float(np.exp(np.interp(quality, x, np.log(y))))


def gains(rows: list[dict]) -> dict[str, float | None]:
    """{a recipe's way: how many times the images per CPU-second ours has at its PSNR}, the geometric mean over the
    objects of which ours has such a PSNR; None where there is none."""
    found: dict[str, float | None] = {}
    for way in [w for w in WAYS if w != TRUTH and not WAYS[w].ours]:
        times: list[float] = []
        for name in dict.fromkeys(r["object"] for r in rows):
            part = [r for r in rows if r["object"] == name]
            (theirs,) = [r for r in part if r["way"] == way]
            at = ours_at(part, theirs["psnr"])
            times += [] if at is None else [seconds_an_image(theirs) / at]
        found[way] = float(np.exp(np.mean(np.log(times)))) if times else None
    return found


def _page(stem: Path, rows: list[dict], size: int, made_by: Provenance) -> str:
    times = gains(rows)
    head = ["way", "PSNR (dB)", "images per CPU-second", "ours at that PSNR", "start", "import", "measure", "an image"]
    cells = []
    for way in dict.fromkeys(r["way"] for r in rows):
        part = [r for r in rows if r["way"] == way]

        def mean(values) -> float:
            return float(np.mean(list(values)))

        gain = "" if WAYS[way].ours else f"{times[way]:.2f} times" if times[way] else "–"
        line = [way, f"{mean(r['psnr'] for r in part):.1f}", f"{1 / mean(map(seconds_an_image, part)):.3f}", gain]
        line += [f"{mean(r[k] for r in part):.3f}" for k in ("start", "import", "measure", "image")]
        cells.append([*line, *(f"{mean(r['stages'].get(k, 0) for r in part):.4f}" for k in STAGES)])
    names = ", ".join(dict.fromkeys(r["object"] for r in rows))
    notes = [
        f"{names}; {size}x{size} pixels, {rows[0]['images']} views of each, {IMAGES} counted an object; PSNR to 512 "
        f"samples. {machine()['cpu']}, one thread. Seconds are the processor's: once an object (start of Blender, "
        "import, measuring the bounds), then an image, and of it: what comes before the first sample, samples, "
        "denoising, reading the EXR that Blender wrote, PNG, and the EXR of depth and motion, which the recipes lack.",
        "Objaverse-XL and TRELLIS: 128 samples, few bounces, denoised, with their filters (0.01 pixels wide; a box of "
        "one), under our light, for all must show the same. What holds their PSNR down is edges, light that is left "
        "out and the denoiser, not noise. 128 and 16 samples alone: with our filter, all bounces, and not denoised, so "
        "that only how it is run differs: one render an image, and nothing kept.",
    ]
    return write_table(stem, "The renderer and the field's recipe", [*head, *STAGES], cells, made_by, notes)


def draw(stem: Path, rows: list[dict], caption: str) -> None:
    """A panel an object: PSNR over CPU-seconds an image, ours as a line and each recipe as a point."""
    names = list(dict.fromkeys(r["object"] for r in rows))
    fig, axes = panels(len(names), 4.6, 3.9)
    for ax, name in zip(axes, names, strict=True):
        part = [r for r in rows if r["object"] == name]
        ours = [r for r in part if WAYS[r["way"]].ours]
        at = [(seconds_an_image(r), r["psnr"]) for r in ours]
        ax.plot(*zip(*at, strict=True), color=COLOURS[0], marker="o", markersize=4.5, linewidth=1.2, label="ours")
        for (x, y), r in zip(at, ours, strict=True):
            ax.annotate(f"{WAYS[r['way']].samples}", (x, y), (5, -9), textcoords="offset points", fontsize=7.5)
        for i, r in enumerate([r for r in part if not WAYS[r["way"]].ours], 1):
            x, y = seconds_an_image(r), r["psnr"]
            ax.plot([x], [y], MARKERS[i], color=COLOURS[i], markersize=7, label=r["way"])
            if (same := ours_at(part, y)) is not None:
                arrow = {"arrowstyle": "->", "color": COLOURS[i], "lw": 0.8, "ls": ":"}
                ax.annotate("", (same, y), (x, y), arrowprops=arrow)
                look = {"textcoords": "offset points", "color": COLOURS[i], "ha": "center"}
                ax.annotate(f"{x / same:.1f}×", ((x * same) ** 0.5, y), (0, 3), **look)
        ax.set(xscale="log", title=name, xlabel="CPU-seconds an image; numbers: samples a pixel")
        ax.set_ylabel("PSNR to 512 samples (dB)")
        ax.margins(0.1, 0.12)
        plain(ax)
    axes[0].legend(loc="upper left", fontsize=8)
    save(fig, stem, caption)
