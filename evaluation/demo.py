# SPDX-License-Identifier: GPL-3.0-or-later
"""`timesplat demo`: the whole road in one go, from an animated object to an asset, with pictures and figures."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

DEMO_SEED = 1_000_013  # a walking figure; checkpoints are trained on seeds below a million
METHODS = ("white", "hull", "lift", "guided", "guided+budget:10%", "tracks:5", "deform+quality:balanced")
SHOWN = ("lift", "guided+budget:10%", "tracks:5", "deform+quality:balanced")  # in pictures
EXPORTED = "tracks:5"  # the method whose Gaussians are exported


@dataclass(frozen=True)
class DemoOptions:
    """What `timesplat demo` is asked for; see `add_arguments`."""

    asset: str | None = None
    out: Path = Path("out/demo")
    size: int = 128
    samples: int = 32
    command: str = ""  # as it was typed, for the tables


def add_arguments(p: argparse.ArgumentParser) -> None:
    """The arguments of `timesplat demo`."""
    d = DemoOptions()
    p.add_argument(
        "asset", nargs="?", help="an animated file, or zoo:SEED (default: a procedural object no checkpoint saw)"
    )
    p.add_argument("--out", type=Path, default=d.out, help="folder to write (default: %(default)s)")
    p.add_argument("--size", type=int, default=d.size, help="pixels, a multiple of 8 (default: %(default)s)")
    p.add_argument("--samples", type=int, default=d.samples, help="Cycles samples (default: %(default)s)")


def demo(options: DemoOptions, save_blend: Callable[[Path, Path], None]) -> int:
    """The command; save_blend(ply, blend) writes the .blend. Returns 0, raises InputError."""
    from tqdm import tqdm

    from ..datagen.farm import render_shots
    from ..datagen.render_job import RenderSettings
    from ..model.clip import clip_of
    from ..model.io.ply import write_ply
    from ..model.io.usd_write import write_usd
    from . import protocol
    from .cache import Cache
    from .method_spec import parse_spec
    from .provenance import Provenance
    from .runner import Conditions, Run, key_of, run_all
    from .tables import gather, table, write_metrics

    out = options.out
    out.mkdir(parents=True, exist_ok=True)
    clock = time.perf_counter()
    settings = RenderSettings(targets=1, size=options.size, samples=options.samples)
    with tqdm(desc="rendering", unit="image", total=0, disable=None) as bar:

        def progress(done: int, total: int) -> None:
            bar.total, bar.n = total, done
            bar.refresh()

        seq = render_shots(options.asset or f"zoo:{DEMO_SEED}", out / "render", "demo", settings, progress=progress)
    seconds = {"rendering": time.perf_counter() - clock}
    targets, turn = protocol.held_out(seq), seq.select(rig="turntable")
    inputs = [i for i in seq.inputs() if seq.views[i].rig != "turntable"]
    print(f"{len(inputs)} input views, {len(targets)} held-out views, {len(turn)} turntable views")

    name, cache, conditions = str(seq.provenance.get("asset", "demo")), Cache(out / "cache"), Conditions(scenes=True)
    where = (tuple(inputs), tuple(targets), seq.width, {"setup": "", "stride": 1})
    runs = [Run(name, seq.folder, parse_spec(m), *where) for m in METHODS]
    rows = run_all(runs, cache, conditions, "reconstructing")
    kept = {m: cache.scene(key_of(r, conditions)) for m, r in zip(METHODS, runs, strict=True)}
    scenes = {m: g for m, g in kept.items() if g is not None}  # all of them
    for row in rows:
        seconds[row["method"]] = row["seconds"]

    clock = time.perf_counter()
    asset = scenes[EXPORTED].to_asset(clip_of(seq))
    write_ply(out / "asset.ply", asset)
    write_usd(out / "asset.usdc", asset)
    save_blend(out / "asset.ply", out / "asset.blend")
    seconds["export"] = time.perf_counter() - clock

    clock = time.perf_counter()
    _pictures(out, seq, targets, turn, scenes)
    seconds["pictures"] = time.perf_counter() - clock
    metrics = gather(rows, Provenance.of(options.command, [r.method.weights for r in runs])) | {"seconds": seconds}
    write_metrics(out, metrics)
    print(table(metrics))
    print("seconds: " + ", ".join(f"{k} {v:.1f}" for k, v in seconds.items()))
    print(f"look at {out}/comparison.png and {out}/turntable.webp; open {out}/asset.blend in Blender")
    return 0


def _pictures(out: Path, seq, targets: list[int], turn: list[int], scenes: dict) -> None:
    """comparison.png: truth above each prediction, at six held-out views over time and six turntable views;
    turntable.webp: the same side by side while camera and time move."""
    import torch

    from ..model.views import load_views
    from .pictures import grid, video
    from .scoring import draw

    held_out, turntable = load_views(seq, targets), load_views(seq, turn)
    some_held_out = torch.linspace(0, len(held_out) - 1, 6).round().long()
    around = torch.linspace(0, len(turntable) - 1, 7).round().long()[:6]
    titles = [f"held out {round(float(t / held_out.frame_step) + 11.5)}" for t in held_out.time[some_held_out]]
    titles += [f"turntable {int(i)}" for i in around]
    rows = {"truth": torch.cat([held_out[some_held_out].over(), turntable[around].over()])}
    film = {"truth": turntable.over()}
    for method in SHOWN:
        film[method] = draw(scenes[method], turntable)[0]
        rows[method] = torch.cat([draw(scenes[method], held_out[some_held_out])[0], film[method][around]])
    grid(rows, titles).save(out / "comparison.png")
    video(out / "turntable.webp", film, seq.fps)
