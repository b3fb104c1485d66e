# SPDX-License-Identifier: GPL-3.0-or-later
"""The Triton backend against the slow float64 reference.

On a machine with CUDA the kernels run compiled. Elsewhere one test runs this file once more with Triton's
interpreter, which has to be asked for before triton is imported, and another compiles the kernels for a card that
is not there."""

import os
import subprocess
import sys
from dataclasses import replace

import pytest
import torch

from timesplat.model.rasterize import render

from .scenes import assert_equals_reference, cameras, cloud, scenes, with_gradients

triton = pytest.importorskip("triton", reason="needs triton")

INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"
DEVICE = "cpu" if INTERPRETED else "cuda"
CLOSE = 1e-4 if INTERPRETED else 1e-3  # of gradients; a card's exp2 may put a pixel on the other side of 1/255
runs = pytest.mark.skipif(
    not (INTERPRETED or torch.cuda.is_available()),
    reason="needs an NVIDIA GPU; without one test_under_the_interpreter runs it",
)


@pytest.mark.skipif(INTERPRETED, reason="this is the run under the interpreter")
def test_under_the_interpreter():
    run = [sys.executable, "-m", "pytest", "--import-mode=importlib", "-p", "no:cacheprovider", __file__]
    done = subprocess.run(run, capture_output=True, text=True, env=os.environ | {"TRITON_INTERPRET": "1"})
    assert done.returncode == 0, done.stdout + done.stderr
    assert " passed" in done.stdout and "failed" not in done.stdout


@pytest.mark.skipif(INTERPRETED, reason="interpreted kernels have no compiler")
@pytest.mark.parametrize(
    "name, types, constants",
    [
        ("cull", "FFFFFDFi", {"INFERENCE": True, "BLOCK": 128}),
        ("project", "IFFFFFFFDFIiiiiii", {"BLOCK": 128}),
        ("blend", "FIIFFFFIiiii", {}),
        ("unblend", "FIIIFFFFIFiiii", {}),
        ("add_pairs", "FLFi", {"BLOCK": 8}),
        ("chain_rule", "IFFFFFFFFDFFFFFFFii", {"BLOCK": 128}),
    ],
)
def test_compiles_without_a_card(name, types, constants, tmp_path, monkeypatch):
    """What the interpreter lets pass, wrong types above all, the compiler does not."""
    from triton.backends.compiler import GPUTarget

    from timesplat.model.rasterize import triton_kernels

    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path))
    kernel = getattr(triton_kernels, name)
    words = {"F": "*fp32", "D": "*fp64", "I": "*i32", "L": "*i64", "i": "i32"}
    names = [n for n in kernel.arg_names if n not in constants]
    signature = dict(zip(names, map(words.get, types), strict=True)) | dict.fromkeys(constants, "constexpr")
    source = triton.compiler.ASTSource(fn=kernel, signature=signature, constexprs=constants)
    assert triton.compile(source, target=GPUTarget("cuda", 80, 32)).asm["cubin"]


def compare(g, view, **options):
    return assert_equals_reference(g, view, "triton", DEVICE, pixels=1e-5, gradients=CLOSE, **options)


def affordable():
    """All scenes; under the slow interpreter fewer, of fewer Gaussians."""
    for name, g, view in scenes():
        if INTERPRETED and name in ("tiles", "tiny", "huge", "brief", "fast"):
            continue
        if INTERPRETED and name != "opaque stack":  # whose pixels must stop
            g = g[::4]
        yield pytest.param(g, view, id=name)


@runs
@pytest.mark.parametrize("g, view", [*affordable()])
def test_equals_reference(g, view):
    compare(g, view, background=torch.tensor([0.2, 1.0, 0.6]))


@runs
def test_a_view_without_gaussians():
    view = cameras(3, 20, 37)
    g = replace(cloud(20, sigma_t=(0.01, 0.02)), t=view[2][[0, 2]].repeat(10))
    _, alpha, _ = compare(g, view)
    assert (alpha.amax((1, 2)) > 0).tolist() == [True, False, True]


@runs
def test_inference_filters():
    g, view = cloud(50), cameras(2, 20, 20)
    want = render(g, *view, inference=True, backend="reference")
    got = render(g.to(DEVICE), *view, inference=True, backend="triton")
    for a, b in zip(got, want, strict=True):
        torch.testing.assert_close(a.cpu(), b, rtol=0, atol=1e-5)
    assert (want[1] - render(g, *view, backend="reference")[1]).abs().max() > 1e-3


@runs
def test_same_bits_on_every_run():
    g, view = cloud(20, scale=(0.02, 0.1)), cameras(2, 20, 14)
    one, two = (with_gradients(g, view, "triton", device=DEVICE) for _ in range(2))
    assert torch.equal(one[0], two[0]) and torch.equal(one[1], two[1])
    assert all(torch.equal(x, two[2][k]) for k, x in one[2].items())


@runs
def test_no_views_and_dtype_is_kept():
    g, (c2w, K, times, width, height) = cloud(10).to(DEVICE, torch.float64), cameras(1, 8, 9)
    assert render(g, c2w, K, times, width, height, backend="triton")[0].dtype == torch.float64
    rgb, alpha = render(g, c2w[:0], K[:0], times[:0], width, height, backend="triton")
    assert rgb.shape == (0, height, width, 3) and alpha.shape == (0, height, width)


@pytest.mark.skipif(INTERPRETED, reason="the interpreter takes CPU tensors")
def test_tensors_must_be_on_a_card():
    with pytest.raises(ValueError, match="CUDA device"):
        render(cloud(3), *cameras(), backend="triton")


def test_missing_triton_is_named(monkeypatch):
    monkeypatch.delitem(sys.modules, "timesplat.model.rasterize.triton", raising=False)
    monkeypatch.setitem(sys.modules, "triton", None)
    with pytest.raises(ImportError, match="needs triton"):
        render(cloud(3), *cameras(), backend="triton")


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs an NVIDIA GPU")
def test_stands_in_for_gsplat(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", None)
    g, view = cloud(50).to("cuda"), cameras()
    for a, b in zip(render(g, *view), render(g, *view, backend="triton"), strict=True):
        assert torch.equal(a, b)
