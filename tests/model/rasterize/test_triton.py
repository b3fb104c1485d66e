# SPDX-License-Identifier: GPL-3.0-or-later
"""The Triton backend against the slow float64 reference, on the scenes and with the measures of test_rasterize.py.

On a machine with CUDA the kernels run compiled. Elsewhere one test runs this file once more with Triton's
interpreter, which has to be asked for before triton is imported, and another compiles the kernels for a card that
is not there."""

import os
import subprocess
import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import pytest
import torch

triton = pytest.importorskip("triton", reason="needs triton")

spec = spec_from_file_location("test_rasterize", Path(__file__).with_name("test_rasterize.py"))
scenes = module_from_spec(spec)
spec.loader.exec_module(scenes)
one_thread, rasterize, NAMES = scenes.one_thread, scenes.rasterize, scenes.NAMES

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
        ("_cull", "FFFFFDFi", {"INFERENCE": True, "BLOCK": 128}),
        ("_project", "IFFFFFFFDFIiiiiii", {"BLOCK": 128}),
        ("_blend", "FIIFFFFIiiii", {}),
        ("_unblend", "FIIIFFFFIFiiii", {}),
        ("_add", "FLFi", {"BLOCK": 8}),
        ("_chain", "IFFFFFFFFDFFFFFFFii", {"BLOCK": 128}),
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


def with_gradients(g, view, **kw):
    """As scenes.with_gradients, on the device."""
    g = {k: v.detach().to(DEVICE).requires_grad_() for k, v in g.items()}
    rgb, alpha = rasterize(*g.values(), *view, backend="triton", **kw)
    rng = torch.Generator().manual_seed(7)
    a, b = torch.randn(rgb.shape, generator=rng), torch.randn(alpha.shape, generator=rng)
    ((rgb * a.to(DEVICE)).sum() + (alpha * b.to(DEVICE)).sum()).backward()
    return rgb.detach().cpu(), alpha.detach().cpu(), [v.grad.cpu() for v in g.values()]


def compare(g, view, **kw):
    """Asserts that image, alpha and the seven gradients equal the reference's; returns the reference's."""
    got, want = with_gradients(g, view, **kw), scenes.with_gradients(g, view, "reference", torch.float64, **kw)
    for a, b in zip(got[:2], want[:2], strict=True):
        assert a.shape == b.shape
        error = (a - b).abs().flatten() / max(1, b.abs().max())
        assert error.sort().values[: max(1, int(0.999 * len(error)))].max() < 1e-5
        assert error.max() < 2e-2
    for name, a, b in zip(NAMES, got[2], want[2], strict=True):
        assert a.isfinite().all(), name
        assert (a - b).norm() <= CLOSE * b.norm() + 1e-9, (name, ((a - b).norm() / b.norm()).item())
    return want


def affordable():
    """All scenes; under the slow interpreter fewer, of fewer Gaussians."""
    for name, g, view in scenes.scenes():
        if INTERPRETED and name in ("tiles", "tiny", "huge", "brief", "fast"):
            continue
        if INTERPRETED and name != "opaque stack":  # whose pixels must stop
            g = {k: v[::4] for k, v in g.items()}
        yield pytest.param(g, view, id=name)


@runs
@pytest.mark.parametrize("g, view", [*affordable()])
def test_equals_reference(g, view):
    compare(g, view, background=torch.tensor([0.2, 1.0, 0.6]))


@runs
def test_a_view_without_gaussians():
    c2w, K, times, width, height = scenes.cameras(3, 20, 37)
    g = scenes.cloud(20, sigma_t=(0.01, 0.02))
    g["t"] = times[[0, 2]].repeat(10)
    _, alpha, _ = compare(g, (c2w, K, times, width, height))
    assert (alpha.amax((1, 2)) > 0).tolist() == [True, False, True]


@runs
def test_inference_filters():
    g, view = scenes.cloud(50), scenes.cameras(2, 20, 20)
    want = rasterize(*g.values(), *view, inference=True, backend="reference")
    got = rasterize(*(x.to(DEVICE) for x in g.values()), *view, inference=True, backend="triton")
    for a, b in zip(got, want, strict=True):
        torch.testing.assert_close(a.cpu(), b, rtol=0, atol=1e-5)
    assert (want[1] - rasterize(*g.values(), *view, backend="reference")[1]).abs().max() > 1e-3


@runs
def test_same_bits_on_every_run():
    g, view = scenes.cloud(20, scale=(0.02, 0.1)), scenes.cameras(2, 20, 14)
    one, two = with_gradients(g, view), with_gradients(g, view)
    assert torch.equal(one[0], two[0]) and torch.equal(one[1], two[1])
    assert all(torch.equal(a, b) for a, b in zip(one[2], two[2], strict=True))


@runs
def test_no_views_and_dtype_is_kept():
    g, (c2w, K, times, width, height) = scenes.cloud(10), scenes.cameras(1, 8, 9)
    g = {k: v.to(DEVICE, torch.float64) for k, v in g.items()}
    assert rasterize(*g.values(), c2w, K, times, width, height, backend="triton")[0].dtype == torch.float64
    rgb, alpha = rasterize(*g.values(), c2w[:0], K[:0], times[:0], width, height, backend="triton")
    assert rgb.shape == (0, height, width, 3) and alpha.shape == (0, height, width)


@pytest.mark.skipif(INTERPRETED, reason="the interpreter takes CPU tensors")
def test_tensors_must_be_on_a_card():
    with pytest.raises(ValueError, match="CUDA device"):
        rasterize(*scenes.cloud(3).values(), *scenes.cameras(), backend="triton")


def test_missing_triton_is_named(monkeypatch):
    monkeypatch.delitem(sys.modules, "timesplat.model.rasterize.triton_kernels", raising=False)
    monkeypatch.setitem(sys.modules, "triton", None)
    with pytest.raises(ImportError, match="needs triton"):
        rasterize(*scenes.cloud(3).values(), *scenes.cameras(), backend="triton")


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs an NVIDIA GPU")
def test_stands_in_for_gsplat(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", None)
    g, view = {k: v.cuda() for k, v in scenes.cloud(50).items()}, scenes.cameras()
    for a, b in zip(rasterize(*g.values(), *view), rasterize(*g.values(), *view, backend="triton"), strict=True):
        assert torch.equal(a, b)
