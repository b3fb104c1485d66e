# SPDX-License-Identifier: GPL-3.0-or-later
"""How fast the network's forward pass is: `python benchmarks/network.py`; a Markdown table.

Views of a ball (28 % of the patches show it, as with rendered objects), random weights, inference. On the CPU float32
and the small ones, unless `--all`; on CUDA, where there is one, bfloat16 and all of them.

FLOPs are counted exactly, two for a multiply-add: every linear layer over the tokens that pass through it, and
the two products of attention, 4·T²·D a block. What is elementwise is not counted. The floor is that count at the
speed of a large square matrix product, measured on the same machine in the same precision.

On rendered objects (folders of Sequences with passes; the rig `alternating` is the input, `target` is held out) and
with the shipped checkpoints, processor seconds of the network alone, on one thread:
    --tokens FOLDER…      with and without the patches that show nothing, and what that does to the held-out views
    --precision FOLDER…   float32, bfloat16 and 8-bit integers, and attention written out
"""

from __future__ import annotations

import argparse
import contextlib
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
from torch import nn

from timesplat.benchmarks.cameras import ring
from timesplat.benchmarks.timing import least
from timesplat.datagen.readers import open_sequence, sequences_in
from timesplat.evaluation.image_quality import psnr
from timesplat.evaluation.scoring import draw
from timesplat.model.checkpoints_io import CHECKPOINTS, load_network
from timesplat.model.gaussians import Gaussians4D
from timesplat.model.inference import geometry_for
from timesplat.model.network import PRESETS, Network
from timesplat.model.views import Views, load_views

CASES = [("tiny", 24, 64), ("tiny", 24, 128), ("small", 24, 128), ("base", 12, 128), ("base", 24, 256)]
CASES += [("large", 12, 256), ("large", 24, 256), ("large", 48, 256)]
SMALL = 3  # how many of them the CPU does by default


def ball(views: int, size: int) -> Views:
    """The views of a ball from a ring of cameras; its pictures have size² pixels."""
    c2w, intrinsics = ring(views, size)
    axis = (torch.arange(size) + 0.5) / size * 2 - 1
    alpha = (axis[:, None].hypot(axis) < 0.52).float().expand(views, -1, -1)
    return Views(
        rgb=torch.rand(views, size, size, 3),
        alpha=alpha,
        c2w=c2w,
        intrinsics=intrinsics,
        time=torch.linspace(-1, 1, views),
        frame_step=2 / 23,
    )


def flops(network: Network, tokens: int) -> int:
    """Of a forward pass with that many image tokens."""
    c = network.config
    block = 12 * c.width**2  # qkv, projection, MLP
    every = tokens + c.free
    linear = tokens * (network.embed.weight.numel() + network.decode.weight.numel()) + every * c.depth * block
    linear += c.free * c.width * c.free_layout.width
    return 2 * linear + 4 * c.depth * every**2 * c.width


def best(f: Callable[[], object], device: str, seconds: float) -> float:
    """Least seconds of f on the wall, until the device is done."""

    def done() -> None:
        f()
        if device == "cuda":
            torch.cuda.synchronize()

    return least(done, seconds, time.perf_counter)


def peak(device: str) -> float:
    """FLOP/s of a large matrix product."""
    n, kind = (8192, torch.bfloat16) if device == "cuda" else (1536, torch.float32)
    a, b = torch.randn(2, n, n, device=device, dtype=kind)
    return 2 * n**3 / best(lambda: a @ b, device, 2)


def row(name: str, views: Views, drop: bool, device: str, roof: float, seconds: float) -> str:
    torch.manual_seed(0)
    network = Network(replace(PRESETS[name], source="predicted")).to(device).eval()
    views = views.to(device)
    tokens = int(network.kept_patches(views, drop).sum())
    x = torch.randn(tokens, network.config.width, device=device)

    def whole():
        with torch.inference_mode(), torch.autocast(device, torch.bfloat16, enabled=device == "cuda"):
            network(views, drop_empty=drop)

    def blocks():
        with torch.inference_mode(), torch.autocast(device, torch.bfloat16, enabled=device == "cuda"):
            y = x
            for block in network.blocks:
                y = block(y)

    count = flops(network, tokens)
    if device == "cuda":
        torch.cuda.reset_peak_memory_stats()
    total, inside = best(whole, device, seconds), best(blocks, device, seconds)
    memory = f"{torch.cuda.max_memory_allocated() / 2**30:.1f}" if device == "cuda" else ""
    cells = [device, name, f"{sum(p.numel() for p in network.parameters()) / 1e6:.1f}", len(views)]
    cells += [f"{views.size[0]}²", "dropped" if drop else "kept", tokens, f"{count / 1e12:.3f}"]
    cells += [f"{total:.3f}", f"{inside:.3f}", f"{count / total / 1e12:.2f}", f"{count / roof:.3f}"]
    cells += [f"{count / roof / total:.0%}", memory]
    return "| " + " | ".join(map(str, cells)) + " |"


def objects(folders: list[Path]):
    """Name, input Views and held-out Views of every Sequence below the folders."""
    for found in [f for folder in folders for f in sequences_in(folder)]:
        seq = open_sequence(found)
        inputs = load_views(seq, seq.select(rig="alternating"), has_depth=True)
        yield found.parent.name, inputs, load_views(seq, seq.select(rig="target"))


def measure(run: Callable[[], Gaussians4D], targets: Views) -> tuple[float, float]:
    """Least processor seconds of three calls of run(); PSNR of the held-out views."""
    made = []
    seconds = least(lambda: made.append(run()))
    g = made[-1]
    return seconds, float(psnr(draw(g[g.alive()], targets)[0], targets.over()).mean())


@torch.inference_mode()
def tokens(folders: list[Path]) -> None:
    """Prints a table of what dropping empty patches saves, and costs."""
    print("| network | object | patches kept | s all | s kept | ratio | PSNR all | PSNR kept |\n" + "|---" * 8 + "|")
    for name in ("guided", "sweep", "predicted"):
        network, rows = load_network(CHECKPOINTS / f"{name}.safetensors"), []
        for what, views, targets in objects(folders):
            geometry = geometry_for(network.config.source, views)
            slow, before = measure(lambda: network(views, geometry, False), targets)  # noqa: B023
            fast, after = measure(lambda: network(views, geometry, True), targets)  # noqa: B023
            rows.append((float(network.kept_patches(views).float().mean()), slow, fast, slow / fast, before, after))
            print(line(name, what, rows[-1]), flush=True)
        print(line(name, "median", torch.tensor(rows).median(0).values.tolist()))
        print(line(name, "mean", torch.tensor(rows).mean(0).tolist()), flush=True)


def line(name: str, what: str, row) -> str:
    share, slow, fast, ratio, before, after = row
    return f"| {name} | {what} | {share:.0%} | {slow:.3f} | {fast:.3f} | {ratio:.1f} | {before:.2f} | {after:.2f} |"


@torch.inference_mode()
def precision(folders: list[Path]) -> None:
    """Prints a table of the ways to compute the same network."""
    from torch.nn.attention import SDPBackend, sdpa_kernel

    def eight_bits(network: Network) -> nn.Module:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch.ao is on its way out
            return torch.ao.quantization.quantize_dynamic(network, {nn.Linear}, torch.qint8)

    ways = {
        "float32": (lambda n: n, contextlib.nullcontext),
        "bfloat16": (lambda n: n, lambda: torch.autocast("cpu", torch.bfloat16)),
        "8-bit integers": (eight_bits, contextlib.nullcontext),
        "attention written out": (lambda n: n, lambda: sdpa_kernel(SDPBackend.MATH)),
    }
    print("| network | computed in | s, mean | PSNR, mean |\n|---|---|---|---|")
    for name in ("guided", "sweep"):
        network = load_network(CHECKPOINTS / f"{name}.safetensors")
        scenes = [(v, geometry_for(network.config.source, v), t) for _, v, t in objects(folders)]
        for way, (change, context) in ways.items():
            changed, rows = change(network), []
            for views, geometry, targets in scenes:
                with context():
                    rows.append(measure(lambda: changed(views, geometry), targets))  # noqa: B023
            seconds, quality = torch.tensor(rows).mean(0).tolist()
            print(f"| {name} | {way} | {seconds:.3f} | {quality:.2f} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--all", action="store_true", help="the large ones on the CPU as well: many minutes, 16 GB")
    parser.add_argument("--threads", type=int, default=1, help="on the CPU (default: 1)")
    parser.add_argument("--seconds", type=float, default=2, help="per figure")
    parser.add_argument("--tokens", type=Path, nargs="+", metavar="FOLDER", help="dropping tokens, on these objects")
    parser.add_argument("--precision", type=Path, nargs="+", metavar="FOLDER", help="number formats, on these objects")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    if args.tokens or args.precision:
        if args.tokens:
            tokens(args.tokens)
        if args.precision:
            precision(args.precision)
        return

    head = ["on", "preset", "M weights", "views", "size", "empty patches", "tokens", "TFLOP"]
    head += ["s", "s in blocks", "TFLOP/s", "floor s", "share of peak", "GB"]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    print("\n".join(lines))
    for device in ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]:
        roof = peak(device)
        for name, views, size in CASES if args.all or device == "cuda" else CASES[:SMALL]:
            for drop in (True, False):
                print(row(name, ball(views, size), drop, device, roof, args.seconds), flush=True)
        print(f"\n{device}: a large matrix product does {roof / 1e12:.3f} TFLOP/s\n")


if __name__ == "__main__":
    main()
