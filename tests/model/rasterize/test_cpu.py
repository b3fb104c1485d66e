# SPDX-License-Identifier: GPL-3.0-or-later
"""The compiled rasteriser against the slow float64 reference."""

import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from timesplat.model import rasterize as package
from timesplat.model.rasterize import render

from .scenes import assert_equals_reference, cameras, cloud, gaussians, scenes, with_gradients


@pytest.mark.parametrize("g, view", [pytest.param(g, v, id=name) for name, g, v in scenes()])
def test_equals_reference(g, view):
    rgb, alpha, _ = assert_equals_reference(g, view, "cpu", background=torch.tensor([0.2, 1.0, 0.6]))
    assert rgb.isfinite().all() and alpha.min() >= 0 and alpha.max() <= 1 - 1e-4 + 1e-9


def test_scenes_are_what_they_claim():
    """Otherwise the comparison above could be of empty images."""
    alpha = {name: render(g, *v)[1] for name, g, v in scenes()}
    empty = {"none", "dead", "behind", "off-screen"}
    assert {name for name, a in alpha.items() if a.max() == 0} == empty
    assert (alpha["opaque stack"] > 0.999).float().mean() > 0.1


def test_scale_and_rotation_do_as_their_covariance():
    """They go to the compiled code as they are; unit length of a quaternion is not asked for."""
    view, results = cameras(), []
    for fused in (True, False):
        leaves = gaussians().map(lambda x: x.clone().requires_grad_())
        g = leaves if fused else replace(leaves, cov3=leaves.covariance3())
        rgb, alpha = render(g, *view)
        rng = torch.Generator().manual_seed(7)
        ((rgb * torch.randn(rgb.shape, generator=rng)).sum() + alpha.sum()).backward()
        grads = (getattr(leaves, k).grad for k in ("xyz", "sigma_t", "scale", "rotation", "opacity"))
        results.append((rgb.detach(), *grads))
    for a, b in zip(*results, strict=True):
        assert (a - b).norm() <= 1e-5 * b.norm() and b.norm() > 0


def test_same_bits_on_every_run_and_any_number_of_threads():
    g, view = cloud(400), cameras(3, 150, 100)
    runs = []
    for n in (2, 2, 1, 3):
        torch.set_num_threads(n)
        runs.append(with_gradients(g, view, "cpu"))
    for rgb, alpha, grads in runs[1:]:
        assert torch.equal(rgb, runs[0][0]) and torch.equal(alpha, runs[0][1])
        assert all(torch.equal(grads[k], x) for k, x in runs[0][2].items())


def test_kernels_are_compiled_again_when_a_file_they_share_changes(tmp_path):
    """By itself numba's cache looks only at the file that a function is in."""
    folder = tmp_path / "model" / "rasterize"
    shutil.copytree(Path(package.__file__).parent, folder, ignore=shutil.ignore_patterns("__pycache__"))
    for name, stub in (
        ("gaussians", "Gaussians4D = DynamicScene"),
        ("views", "BACKGROUND"),
        ("parallel", "parallel_for"),
    ):
        (tmp_path / "model" / f"{name}.py").write_text(f"{stub} = None")
    code = """
import importlib, numpy
from model.rasterize.cpu import jit, project
def hits():
    importlib.reload(jit)
    kernel = importlib.reload(project).all_finite
    kernel((numpy.ones(1, numpy.float32),))
    return sum(kernel.stats.cache_hits.values())
print(hits(), hits())
for name in ("cpu/simd.py", "cpu/layout.py", "constants.py"):
    with open("model/rasterize/" + name, "a") as f:
        f.write("# changed")
    print(hits(), hits())
"""
    run = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert run.stdout.split() == ["0", "1"] * 4
