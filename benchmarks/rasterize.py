# SPDX-License-Identifier: GPL-3.0-or-later
"""How fast the rasteriser is: `python benchmarks/rasterize.py`.

Random Gaussians in the unit ball (σ of 0.005 to 0.03, σ_t = 0.3), 4 views. CPU-ms and wall-ms of the best of
several calls, forward and forward + backward, on one and on two threads.

The floor, counted, per (visible Gaussian, view) pair and per step of eight pixels that the exact footprint
needs at the least:
- memory: a Gaussian's inputs are 25 floats and its gradients 25 (read and written), 300 B; its projected row is
  written once and read twice, 192 B; its pixel sums 72 B: about 600 B, at 10 GB/s 60 ns;
- flops: projection 150 and chain rule 300 in scalar float64; 30 vector instructions forward and 45 backward a
  step. At two instructions a cycle and 2.5 GHz: 90 ns a pair and 15 ns a step.
Memory and arithmetic overlap, so the floor is the larger one: 90 ns · pairs + 15 ns · steps.
"""

from __future__ import annotations

import argparse
import math
import subprocess
import sys
import time

import torch

from timesplat.model.gaussians import rotation_matrix
from timesplat.model.rasterize import rasterize


def scene(n, size, views, seed=0):
    torch.manual_seed(seed)
    xyz = torch.nn.functional.normalize(torch.randn(n, 3), dim=1) * torch.rand(n, 1) ** (1 / 3)
    M = rotation_matrix(torch.nn.functional.normalize(torch.randn(n, 4), dim=1))
    M = M * (0.005 + 0.025 * torch.rand(n, 1, 3))
    g = [xyz, 2 * torch.rand(n) - 1, 0.1 * torch.randn(n, 3), torch.full((n,), 0.3), M @ M.mT]
    g = [x.requires_grad_() for x in (*g, torch.rand(n, 3), torch.rand(n))]
    poses = []
    for i in range(views):
        a = 0.1 + 2 * math.pi * i / views
        right = torch.tensor([-math.sin(a), math.cos(a), 0.0])
        forward = torch.tensor([-math.cos(a), -math.sin(a), 0.0])
        pose = torch.eye(4)
        pose[:3] = torch.stack([right, torch.linalg.cross(forward, right), forward, -2.7 * forward], 1)
        poses.append(pose)
    f = 0.5 * size / math.tan(math.radians(25))
    K = torch.tensor([f, f, size / 2, size / 2]).expand(views, 4)
    return g, (torch.stack(poses), K, torch.linspace(-0.8, 0.8, views), size, size)


def footprint(g, view):
    """Pairs (visible Gaussian, view), and steps of eight pixels if every row of a footprint were one span."""
    xyz, t, velocity, sigma_t, cov, _, opacity = (x.detach() for x in g)
    c2w, K, times = view[:3]
    pairs = steps = 0
    for i in range(len(times)):
        dt = times[i] - t
        o = opacity * torch.exp(-0.5 * (dt / sigma_t) ** 2)
        z = (xyz + velocity * dt[:, None] - c2w[i, :3, 3]) @ c2w[i, :3, 2]
        # isotropic stand-in for the 2D covariance, and 1/255 as the edge
        sigma = (cov.diagonal(dim1=1, dim2=2).mean(1) * (K[i, 0] / z) ** 2 + 0.3).sqrt()
        reach = (sigma * (2 * (255 * o).clamp_min(1).log()).sqrt())[o >= 1 / 255]
        pairs += len(reach)
        steps += (2 * reach * (math.pi / 2 * reach / 8).clamp_min(1)).sum().item()
    return pairs, steps


def best(f, seconds):
    """Least CPU-ms and wall-ms of f over about `seconds`, at least three calls."""
    f()
    cpu = wall = math.inf
    end, calls = time.perf_counter() + seconds, 0
    while calls < 3 or time.perf_counter() < end:
        c, w = time.process_time(), time.perf_counter()
        f()
        cpu, wall = min(cpu, time.process_time() - c), min(wall, time.perf_counter() - w)
        calls += 1
    return 1e3 * cpu, 1e3 * wall


def timings(g, view, seconds, backend="cpu"):
    def forward():
        with torch.no_grad():
            rasterize(*g, *view, backend=backend)

    def both():
        rgb, alpha = rasterize(*g, *view, backend=backend)
        (rgb.mean() + alpha.mean()).backward()

    return best(forward, seconds), best(both, seconds)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=1.5, help="per figure")
    parser.add_argument("--sizes", default="24600x128,98000x256,393000x256", help="Gaussians x pixels, comma-separated")
    args = parser.parse_args()

    code = "import timesplat.model.rasterize as r, torch; z = torch.zeros; import time; s = time.perf_counter();"
    code += "o = torch.ones; r.rasterize(z(1,3),z(1),z(1,3),o(1),torch.eye(3)[None],o(1,3,requires_grad=True),o(1),"
    code += "torch.eye(4)[None],o(1,4),z(1),8,8)[0].sum().backward(); print(time.perf_counter() - s)"
    first = [float(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout)]
    print(f"start-up after `import torch`, compiled code from the cache: {first[0]:.2f} s")

    print("Gaussians  image threads | fwd cpu-ms wall-ms | fwd+bwd cpu-ms wall-ms | floor ms  times the floor")
    for n, size in (map(int, s.split("x")) for s in args.sizes.split(",")):
        g, view = scene(n, size, args.views)
        pairs, steps = footprint(g, view)
        floor = 1e-6 * (90 * pairs + 15 * steps)
        for threads in (1, 2):
            torch.set_num_threads(threads)
            (fc, fw), (bc, bw) = timings(g, view, args.seconds)
            print(
                f"{n:9d} {size:5d}² {threads:7d} | {fc:10.1f} {fw:7.1f} | {bc:14.1f} {bw:7.1f} |"
                f" {floor:8.1f} {bc / floor:16.2f}"
            )
    torch.set_num_threads(1)
    g, view = scene(1000, 64, 2)
    fast, slow = (timings(g, view, args.seconds, backend)[1][0] for backend in ("cpu", "reference"))
    print(f"1000 Gaussians, 64², 2 views, fwd+bwd: {fast:.1f} ms, reference {slow:.0f} ms: {slow / fast:.0f} times")


if __name__ == "__main__":
    main()
