# SPDX-License-Identifier: GPL-3.0-or-later
"""Scores: methods on held-out views of rendered Sequences, as tables and `metrics.json`."""

from __future__ import annotations

import json
import os
import platform
import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from ..datagen.sequence import Sequence
from .gaussians import Gaussians4D
from .metrics import psnr, psnr_foreground, ssim
from .rasterize import render
from .reconstruct import NEEDS_PASSES, reconstruct_views
from .views import Views, load_views

COLUMNS = ["psnr", "psnr_p5", "psnr_worst", "psnr_fg", "psnr_fg_p5", "psnr_fg_worst", "ssim"]
COLUMNS += ["seconds", "gaussians", "gaussians_kept"]


def draw(g: Gaussians4D, views: Views) -> tuple[torch.Tensor, torch.Tensor]:
    """Pictures (C,H,W,3) over white and alpha (C,H,W) of the Gaussians from the cameras and times of views,
    with the paper's inference filters."""
    height, width = views.size
    with torch.no_grad():
        return render(g, views.c2w, views.intrinsics, views.time, width, height, inference=True)


def evaluate_method(seq: Sequence, method: str, inputs, targets, checkpoint: Path | None = None):
    """Reconstructs from the views `inputs` and scores the views `targets` (indices) -> dict of COLUMNS with
    per-view lists `frames` beside, and the Gaussians that the filters keep."""
    start = time.perf_counter()
    views = load_views(seq, inputs, passes=method in NEEDS_PASSES)
    with torch.inference_mode():
        g = reconstruct_views(views, method, checkpoint=checkpoint)
        kept = g[g.alive()]
    seconds = time.perf_counter() - start
    truth = load_views(seq, targets)
    rgb, alpha = draw(kept, truth)
    target = truth.over(1.0)
    frames = {
        "psnr": psnr(rgb, target),
        "psnr_fg": psnr_foreground(rgb, target, alpha, truth.alpha),
        "ssim": ssim(rgb, target),
    }
    frames = {k: v.tolist() for k, v in frames.items()}
    row = summarise(frames) | {"seconds": seconds, "gaussians": len(g), "gaussians_kept": len(kept)}
    return row | {"frames": frames}, kept


def warm_up(seq: Sequence, inputs, methods: list[str], checkpoint: Path | None = None) -> None:
    """Runs every method once on two views, so that no timing holds the compilation of kernels (about fifteen
    seconds, the first time on a machine) or imports."""
    with torch.inference_mode():
        for method in methods:
            reconstruct_views(load_views(seq, inputs[:2], method in NEEDS_PASSES), method, checkpoint=checkpoint)


def evaluate_folders(sequences: dict[str, Sequence], methods: list[str], out: Path, checkpoint: Path | None = None):
    """Scores every method on every Sequence {name: Sequence}: its views of rig "target" are held out, all the
    others are input. Writes metrics.json and metrics.md below `out`, prints the table, returns the metrics."""
    objects: dict[str, dict[str, dict]] = {}
    bar = tqdm(total=len(sequences) * len(methods), desc="evaluating", unit="run", disable=None)
    for name, seq in sequences.items():
        inputs = [i for i, v in enumerate(seq.views) if v.rig != "target"]
        if not objects:
            warm_up(seq, inputs, methods, checkpoint)
        objects[name] = {}
        for method in methods:
            bar.set_postfix_str(f"{name} {method}")
            row, _ = evaluate_method(seq, method, inputs, seq.select(rig="target"), checkpoint)
            objects[name][method] = row
            bar.update()
        write_metrics(out, collect(objects))
    bar.close()
    metrics = collect(objects)
    print(table(metrics))
    return metrics


def summarise(frames: dict[str, list[float]]) -> dict[str, float]:
    """Per-view scores -> mean, 5th percentile and worst."""
    out = {}
    for k, v in frames.items():
        out[k] = float(np.mean(v))
        if k != "ssim":
            out[f"{k}_p5"], out[f"{k}_worst"] = float(np.percentile(v, 5)), float(np.min(v))
    return out


def collect(objects: dict[str, dict[str, dict]]) -> dict:
    """{object: {method: row of evaluate_method}} -> what metrics.json holds. The mean over all views of all
    objects; 5th percentile and worst over all views; seconds and counts are means over objects."""
    methods: dict[str, dict] = {}
    for m in next(iter(objects.values())):
        rows = [o[m] for o in objects.values() if m in o]
        frames = {k: [x for r in rows for x in r["frames"][k]] for k in rows[0]["frames"]}
        rest = {k: float(np.mean([r[k] for r in rows])) for k in ("seconds", "gaussians", "gaussians_kept")}
        methods[m] = summarise(frames) | rest
    per_object = {name: {m: {k: r[k] for k in COLUMNS} for m, r in rows.items()} for name, rows in objects.items()}
    return {"methods": methods, "objects": per_object, "machine": machine(), "versions": versions()}


def machine() -> dict:
    """What the figures were taken on."""
    name = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [x.split(":", 1)[1].strip() for x in cpuinfo.read_text().splitlines() if x.startswith("model name")]
        name = names[0] if names else name
    return {"cpu": name, "cores": len(os.sched_getaffinity(0)), "system": platform.platform()}


def versions() -> dict:
    """Versions of what has a say in the figures."""
    out = {"python": platform.python_version()}
    for package in ("timesplat", "torch", "numpy", "numba", "bpy", "usd-core"):
        try:
            out[package] = version(package)
        except PackageNotFoundError:
            out[package] = None
    return out


def table(metrics: dict) -> str:
    """The methods of metrics.json as a Markdown table."""
    head = ["method", "PSNR", "p5", "worst", "PSNR fg", "p5", "worst", "SSIM", "seconds", "Gaussians", "kept"]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for name, m in metrics["methods"].items():
        cells = [f"{m[k]:.2f}" for k in COLUMNS[:6]] + [f"{m['ssim']:.3f}", f"{m['seconds']:.2f}"]
        cells += [f"{m['gaussians']:.0f}", f"{m['gaussians_kept']:.0f}"]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def write_metrics(folder: Path, metrics: dict) -> None:
    """`metrics.json` and the same as `metrics.md`, each whole or not at all."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in (
        ("metrics.json", json.dumps(metrics, indent=1)),
        ("metrics.md", table(metrics) + "\n"),
    ):
        tmp = folder / f".{name}.tmp"
        tmp.write_text(text)
        tmp.replace(folder / name)
