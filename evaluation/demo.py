# SPDX-License-Identifier: GPL-3.0-or-later
"""`timesplat demo`: the whole road in one go, from an animated object to an asset, with pictures and figures."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import torch
from tqdm import tqdm

from ..datagen.render import Settings, render_shots
from ..model.gaussians import Gaussians4D
from ..model.io.ply import write_ply
from ..model.io.usd_write import write_usd
from ..model.reconstruct import clip_of
from ..model.views import Views, load_views
from .evaluate import draw, evaluate_method, warm_up
from .pictures import grid, video
from .tables import collect, table, write_metrics

DEMO_SEED = 1_000_013  # a walking figure; checkpoints are trained on seeds below a million
METHODS = ("white", "hull", "lift", "guided", "guided+budget:10%", "rgb")
SHOWN = ("lift", "guided", "guided+budget:10%", "rgb")  # in pictures
ASSET = "guided+budget:10%"  # the method whose Gaussians are exported


def run(args: argparse.Namespace, save_blend: Callable[[Path, Path], None]) -> int:
    """args of `timesplat demo`; save_blend(ply, blend) writes the .blend. Returns 0, raises InputError."""
    out = args.out
    out.mkdir(parents=True, exist_ok=True)
    clock = time.perf_counter()
    settings = Settings(targets=1, size=args.size, samples=args.samples)
    with tqdm(desc="rendering", unit="image", total=0, disable=None) as bar:

        def progress(done: int, total: int) -> None:
            bar.total, bar.n = total, done
            bar.refresh()

        seq = render_shots(args.asset or f"zoo:{DEMO_SEED}", out / "render", "demo", settings, progress=progress)
    seconds = {"rendering": time.perf_counter() - clock}
    targets, turn = seq.select(rig="target"), seq.select(rig="turntable")
    inputs = [i for i, v in enumerate(seq.views) if v.rig not in ("target", "turntable")]
    print(f"{len(inputs)} input views, {len(targets)} held-out views, {len(turn)} turntable views")

    warm_up(seq, inputs, METHODS)
    rows, clouds = {}, {}
    for method in METHODS:
        rows[method], clouds[method] = evaluate_method(seq, method, inputs, targets)
        seconds[method] = rows[method]["seconds"]
        print(f"  {method}: {rows[method]['psnr']:.2f} dB in {seconds[method]:.1f} s")

    clock = time.perf_counter()
    asset = clouds[ASSET].to_asset(clip_of(seq))
    write_ply(out / "asset.ply", asset)
    write_usd(out / "asset.usdc", asset)
    save_blend(out / "asset.ply", out / "asset.blend")
    seconds["export"] = time.perf_counter() - clock

    clock = time.perf_counter()
    _pictures(out, load_views(seq, targets), load_views(seq, turn), clouds, seq.fps)
    seconds["pictures"] = time.perf_counter() - clock
    name = str(seq.provenance.get("asset", "demo"))
    metrics = collect({name: rows}) | {"seconds": seconds}
    write_metrics(out, metrics)
    print(table(metrics))
    print("seconds: " + ", ".join(f"{k} {v:.1f}" for k, v in seconds.items()))
    print(f"look at {out}/comparison.png and {out}/turntable.webp; open {out}/asset.blend in Blender")
    return 0


def _pictures(out: Path, held_out: Views, turntable: Views, clouds: dict[str, Gaussians4D], fps: float) -> None:
    """comparison.png: truth above each prediction, at six held-out views over time and six turntable views;
    turntable.webp: the same side by side while camera and time move."""
    few = torch.linspace(0, len(held_out) - 1, 6).round().long()
    some = torch.linspace(0, len(turntable) - 1, 7).round().long()[:6]
    frames = [f"held out {round(float(t / held_out.frame_step) + 11.5)}" for t in held_out.time[few]]
    around = [f"turntable {int(i)}" for i in some]
    rows = {"truth": torch.cat([held_out[few].over(), turntable[some].over()])}
    film = {"truth": turntable.over()}
    for method in SHOWN:
        g = clouds[method]
        film[method] = draw(g, turntable)[0]
        rows[method] = torch.cat([draw(g, held_out[few])[0], film[method][some]])
    grid(rows, frames + around).save(out / "comparison.png")
    video(out / "turntable.webp", film, fps)
