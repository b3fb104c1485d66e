# SPDX-License-Identifier: GPL-3.0-or-later
"""How fast the rasteriser is: `python benchmarks/rasterizer.py [--opensplat DIR] [--ply FILE] [--out DIR]`.

Random Gaussians in the unit ball (σ of 0.005 to 0.03, σ_t = 0.3), and an asset where one is given, in 4 views at 4
times. CPU-ms on one thread, the best of several calls, forward and forward + backward from position, time, velocity,
lifetime, scale, rotation, colour and opacity. With a checkout of OpenSplat, its CPU rasteriser does the same in the
same run: see opensplat.py. To `--out` go rasterizer.csv, .md and .png.

The floor, counted, per (visible Gaussian, view) pair and per step of one block of pixels (8, or 16 with AVX-512) that
the exact footprint needs at the least:
- memory: a Gaussian's inputs are 25 floats and its gradients 25 (read and written), 300 B; its projected row is
  written once and read twice, 192 B; its pixel sums 72 B: about 600 B, at 10 GB/s 60 ns;
- flops: projection 150 and chain rule 300, eight at a time; 30 vector instructions forward and 45 backward a step. At
  two instructions a cycle and 2.5 GHz: 11 ns a pair and 15 ns a step.
Memory and arithmetic overlap, so the floor is the larger one of 60 ns · pairs and 11 ns · pairs + 15 ns · steps.
"""

from __future__ import annotations

import argparse
import csv
import math
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from timesplat.benchmarks import opensplat
from timesplat.benchmarks.cameras import ring
from timesplat.benchmarks.timing import least
from timesplat.evaluation.provenance import machine
from timesplat.model.gaussians import FIELDS, Gaussians4D
from timesplat.model.io.ply import read_ply
from timesplat.model.rasterize import render
from timesplat.model.rasterize.constants import ALPHA_MIN, BLUR
from timesplat.model.rasterize.cpu.simd import ROWS

NAMES = ("scene", "gaussians", "pixels", "views", "forward_ms", "both_ms", "inference_ms", "floor_ms")
NAMES += ("times_floor", "opensplat_forward_ms", "opensplat_both_ms", "ratio", "psnr_db", "difference")


def cloud(n: int, seed: int = 0) -> Gaussians4D:
    torch.manual_seed(seed)
    unit = torch.nn.functional.normalize
    return Gaussians4D(
        xyz=unit(torch.randn(n, 3), dim=1) * torch.rand(n, 1) ** (1 / 3),
        t=2 * torch.rand(n) - 1,
        velocity=0.1 * torch.randn(n, 3),
        sigma_t=torch.full((n,), 0.3),
        scale=0.005 + 0.025 * torch.rand(n, 3),
        rotation=unit(torch.randn(n, 4), dim=1),
        rgb=torch.rand(n, 3),
        opacity=torch.rand(n),
    )


def cameras(count: int, size: int) -> tuple[Tensor, Tensor, Tensor, int, int]:
    """What `render` takes after the scene: `ring`, times (C), width and height in pixels."""
    return *ring(count, size), torch.linspace(-0.8, 0.8, count), size, size


def floor(g: Gaussians4D, view) -> float:
    """CPU-ms, see above; view: of `cameras`. The footprints' area is that of isotropic Gaussians of the same size."""
    c2w, K, times = view[:3]
    pairs = steps = 0
    for i in range(len(times)):
        o = g.opacity * g.marginal(times[i])
        z = (g.position(times[i]) - c2w[i, :3, 3]) @ c2w[i, :3, 2]
        sigma = (g.scale.square().mean(1) * (K[i, 0] / z) ** 2 + BLUR).sqrt()
        reach = (sigma * (2 * (o / ALPHA_MIN).clamp_min(1).log()).sqrt())[o >= ALPHA_MIN]
        pairs += len(reach)
        steps += ((2 * reach / ROWS).clamp_min(1) * (math.pi / 2 * reach / 8).clamp_min(1)).sum().item()
    return 1e-6 * max(60 * pairs, 11 * pairs + 15 * steps)


def best(call: Callable[[], object], seconds: float) -> float:
    """Least CPU-ms of a call."""
    return 1e3 * least(call, seconds)


def timings(draw, leaves: list[Tensor], seconds: float) -> list[float]:
    """`best` of draw() -> (rgb, alpha), without gradients and with those of `leaves`."""

    def forward():
        with torch.no_grad():
            return draw()

    def both():
        for x in leaves:
            x.grad = None
        rgb, alpha = draw()
        (rgb.mean() + alpha.mean()).backward()

    for x in leaves:
        x.requires_grad_()
    return [best(forward, seconds), best(both, seconds)]


def measure(name: str, g: Gaussians4D, size: int, views: int, seconds: float, other=None) -> dict:
    """One row of the table; `other`: OpenSplat, compiled."""
    view, leaves = cameras(views, size), [getattr(g, k) for k in FIELDS]
    row = {"scene": name, "gaussians": len(g), "pixels": size, "views": views, "floor_ms": floor(g, view)}
    row["forward_ms"], row["both_ms"] = timings(lambda: render(g, *view), leaves, seconds)
    row["times_floor"] = row["both_ms"] / row["floor_ms"]
    with torch.no_grad():
        row["inference_ms"] = best(lambda: render(g, *view, inference=True), seconds)
        if other:
            theirs = opensplat.slices(g, view[2], ALPHA_MIN)
            a, b = render(g, *view)[0], opensplat.render(other, theirs, *view)[0]
            row["difference"] = float((a - b).abs().max())
            row["psnr_db"] = float(-10 * (a - b).square().mean().log10())
    if other:
        flat = [x for leaf in theirs for x in leaf]
        cpu = timings(lambda: opensplat.render(other, theirs, *view), flat, seconds)
        row["opensplat_forward_ms"], row["opensplat_both_ms"] = cpu
        row["ratio"] = cpu[1] / row["both_ms"]
    return row


def computer() -> str:
    found = machine()
    return f"{found['cpu']}, {found['cores']} cores, {8 * ROWS} floats a register"


def start_up() -> float:
    """CPU-seconds from `import torch` to the first gradient, compiled code from the cache."""
    code = "import torch, time; s = time.process_time(); from timesplat.model.gaussians import Gaussians4D as G;"
    code += "from timesplat.model.rasterize import render; z, o = torch.zeros, torch.ones;"
    code += "g = G(z(1,3), z(1), z(1,3), o(1), o(1,3), o(1,4), o(1,3,requires_grad=True), o(1));"
    code += "render(g, torch.eye(4)[None], o(1,4), z(1), 8, 8)[0].sum().backward(); print(time.process_time() - s)"
    times = [
        float(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout)
        for _ in range(3)
    ]
    return min(times)


def table(rows: list[dict]) -> str:
    """Markdown."""
    heads = {
        "scene": ("scene", "{}"),
        "gaussians": ("Gaussians", "{}"),
        "pixels": ("pixels", "{}²"),
        "forward_ms": ("forward", "{:.2f}"),
        "both_ms": ("forward + backward", "{:.2f}"),
        "inference_ms": ("forward, inference filters", "{:.2f}"),
        "floor_ms": ("floor", "{:.2f}"),
        "times_floor": ("times the floor", "{:.1f}"),
        "opensplat_forward_ms": ("OpenSplat forward", "{:.1f}"),
        "opensplat_both_ms": ("OpenSplat forward + backward", "{:.1f}"),
        "ratio": ("times faster", "{:.1f}"),
        "psnr_db": ("same picture, dB", "{:.0f}"),
        "difference": ("largest difference", "{:.4f}"),
    }
    keys = [k for k in heads if k in rows[0]]
    lines = [[heads[k][0] for k in keys], ["---"] * len(keys)]
    lines += [[heads[k][1].format(row[k]) for k in keys] for row in rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def page(rows: list[dict], started: float) -> str:
    """rasterizer.md; started: CPU-seconds of the start."""
    text = f"""# The CPU rasteriser

`python benchmarks/rasterizer.py --opensplat DIR --ply FILE --out docs/results` on {computer()}:
{rows[0]["views"]} views, CPU-ms on one thread, the best of several calls.
Start-up after `import torch`: {started:.2f} CPU-s. The floor is
counted in the script.

{table(rows)}"""
    if "ratio" in rows[0]:
        text += """
OpenSplat: the two CPU functions of a checkout, compiled with -O3 -march=native, on the same Gaussians, cameras and
views in the same run; sliced at the cameras' times beforehand, which is not counted. Times faster: of forward +
backward.
"""
    return text


def chart(rows: list[dict], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    fig, ax = plt.subplots(figsize=(9, 4.8), layout="constrained")
    bars = [("forward_ms", "Timesplat, forward", "#9ecae1"), ("both_ms", "Timesplat, forward + backward", "#2171b5")]
    if "ratio" in rows[0]:
        bars.append(("opensplat_forward_ms", "OpenSplat, forward", "#fdd0a2"))
        bars.append(("opensplat_both_ms", "OpenSplat, forward + backward", "#d94801"))
    width = 0.8 / len(bars)
    for k, (key, label, colour) in enumerate(bars):
        at = [i + (k - (len(bars) - 1) / 2) * width for i in range(len(rows))]
        ax.bar(at, [row[key] for row in rows], width, label=label, color=colour)
        for x, row in zip(at, rows, strict=True):
            ax.text(x, row[key], f"{float(f'{row[key]:.3g}'):g}", ha="center", va="bottom", fontsize=7)
    for i, row in enumerate(rows):
        ax.hlines(row["floor_ms"], i - 0.45, i + 0.45, "black", "dashed", linewidth=1, label="" if i else "floor")
    ax.set_yscale("log")
    ax.margins(y=0.12)
    ax.set_ylabel("CPU-ms")
    names = []
    for row in rows:
        text = f"{row['scene']}\n{row['gaussians'] / 1000:.3g}k × {row['pixels']}²"
        text += f"\n{row['times_floor']:.1f} times the floor"
        names.append(text + (f"\n{row['ratio']:.1f} times faster" if "ratio" in row else ""))
    ax.set_xticks(range(len(rows)), names, fontsize=8)
    ax.set_title(f"Rasterising {rows[0]['views']} views on one thread\n{computer()}", fontsize=10)
    ax.legend(fontsize=8, frameon=False)
    ax.spines[["top", "right"]].set_visible(False)
    fig.savefig(path, dpi=150)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=1.5, help="per figure")
    parser.add_argument(
        "--sizes",
        default="2000x64,8000x128,24600x128,98000x256,393000x256",
        help="Gaussians x pixels, comma-separated",
    )
    parser.add_argument("--ply", type=Path, help="an asset to draw as well, at 128²")
    parser.add_argument("--opensplat", type=Path, metavar="DIR", help="a checkout of OpenSplat")
    parser.add_argument("--out", type=Path, metavar="DIR", help="where rasterizer.csv, .md and .png go")
    args = parser.parse_args()

    torch.set_num_threads(1)
    print(computer())
    started = start_up()
    print(f"start-up after `import torch`, compiled code from the cache: {started:.2f} CPU-s", flush=True)
    other = opensplat.compiled(args.opensplat) if args.opensplat else None
    jobs = [("random", cloud(n), size) for n, size in (map(int, s.split("x")) for s in args.sizes.split(","))]
    if args.ply:
        jobs.append((args.ply.stem, Gaussians4D.from_asset(read_ply(args.ply)), 128))
    rows = []
    for name, g, size in jobs:
        rows.append(measure(name, g, size, args.views, args.seconds, other))
        print(" ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in rows[-1].items()), flush=True)
    print(f"\n{args.views} views, CPU-ms on one thread:\n\n{table(rows)}")
    if args.out:
        args.out.mkdir(parents=True, exist_ok=True)
        with open(args.out / "rasterizer.csv", "w", newline="") as f:
            writer = csv.DictWriter(f, [*[k for k in NAMES if k in rows[0]], "machine"])
            writer.writeheader()
            writer.writerows({**row, "machine": computer()} for row in rows)
        (args.out / "rasterizer.md").write_text(page(rows, started))
        chart(rows, args.out / "rasterizer.png")


if __name__ == "__main__":
    main()
