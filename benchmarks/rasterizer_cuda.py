# SPDX-License-Identifier: GPL-3.0-or-later
"""The rasteriser's CUDA backends side by side, and beside the CPU's: `python benchmarks/rasterizer_cuda.py`.

On the scenes of benchmarks/rasterizer.py: milliseconds, forward and forward + backward, the best of several calls
after one that compiles (its seconds are printed too); and the largest differences from the CPU backend, of the
images' values and, relative to its norm, of the worst gradient. gsplat is left out where it is not installed. The
Triton backend was developed under Triton's interpreter, without a card: no figures of it are recorded yet.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
import time
from functools import partial

import torch

from timesplat.benchmarks.rasterizer import cameras, cloud
from timesplat.benchmarks.timing import least
from timesplat.model.gaussians import FIELDS, Gaussians4D
from timesplat.model.rasterize import render


def run(g: Gaussians4D, view, backend: str, backward: bool) -> list[torch.Tensor]:
    """-> [rgb, alpha], or with the gradients of mean(rgb) + mean(alpha); waits for the card."""
    leaves = [getattr(g, k) for k in FIELDS]
    for x in leaves:
        x.grad = None
    with torch.set_grad_enabled(backward):
        out = render(g, *view, backend=backend)
    if backward:
        (out[0].mean() + out[1].mean()).backward()
        out = [*out, *(x.grad for x in leaves)]
    if g.xyz.is_cuda:
        torch.cuda.synchronize()
    return [x.detach() for x in out]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=1.5, help="per figure")
    parser.add_argument("--sizes", default="24600x128,98000x256,393000x256", help="Gaussians x pixels, comma-separated")
    args = parser.parse_args()
    if not torch.cuda.is_available():
        print("This benchmark needs an NVIDIA GPU and a torch built for CUDA.")
        sys.exit(2)

    backends = ["cpu", "triton"] + ["gsplat"] * bool(importlib.util.find_spec("gsplat"))
    print(f"{torch.cuda.get_device_name()}, torch {torch.__version__}, {torch.get_num_threads()} threads for cpu")
    print("Gaussians  image backend | first s  fwd ms fwd+bwd ms | from cpu: image  gradients")
    for n, size in (map(int, s.split("x")) for s in args.sizes.split(",")):
        reference = None
        for backend in backends:
            device = "cpu" if backend == "cpu" else "cuda"
            g = cloud(n).map(lambda x: x.to(device).requires_grad_())  # noqa: B023
            view = [x.to(device) if isinstance(x, torch.Tensor) else x for x in cameras(args.views, size)]
            start = time.perf_counter()
            out = [x.cpu() for x in run(g, view, backend, True)]
            first = time.perf_counter() - start
            reference = reference or out
            image = max((a - b).abs().max().item() for a, b in zip(out[:2], reference[:2], strict=True))
            worst = max(((a - b).norm() / b.norm()).item() for a, b in zip(out[2:], reference[2:], strict=True))
            calls = (partial(run, g, view, backend, backward) for backward in (False, True))
            forward, both = (1e3 * least(call, args.seconds, time.perf_counter) for call in calls)
            print(f"{n:9d} {size:5d}² {backend:>7} | {first:7.2f} {forward:7.2f} {both:10.2f} |", end="")
            print(f" {image:15.1e} {worst:10.1e}")


if __name__ == "__main__":
    main()
