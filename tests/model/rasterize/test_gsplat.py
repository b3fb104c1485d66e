# SPDX-License-Identifier: GPL-3.0-or-later
"""The backend on gsplat: when it is chosen, and on a card that it equals the reference."""

import importlib.machinery
import sys

import pytest
import torch

from timesplat.model.rasterize import gsplat, render

from .scenes import cameras, cloud, scenes, with_gradients


def test_missing_gsplat_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(ImportError, match=r"timesplat\[cuda\]"):
        render(cloud(3), *cameras(), backend="gsplat")


def test_gsplat_is_chosen_only_where_it_is_compiled(monkeypatch, tmp_path):
    monkeypatch.delitem(sys.modules, "gsplat", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "gsplat").mkdir()
    (tmp_path / "gsplat/__init__.py").write_text("raise AssertionError('imported only to look')")
    assert not gsplat.is_compiled()
    (tmp_path / "gsplat" / f"csrc{importlib.machinery.EXTENSION_SUFFIXES[-1]}").touch()
    importlib.invalidate_caches()
    assert gsplat.is_compiled()
    monkeypatch.setitem(sys.modules, "gsplat", None)  # as if not installed
    assert not gsplat.is_compiled()


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs an NVIDIA GPU and gsplat")
@pytest.mark.parametrize("name", ["random", "tiles", "opaque stack", "clamped slope"])
def test_equals_reference(name):
    pytest.importorskip("gsplat", reason="needs gsplat")
    g, view = next((g, v) for n, g, v in scenes() if n == name)
    want = with_gradients(g, view, "reference", torch.float64)
    rgb, alpha, gradients = with_gradients(g, view, "gsplat", device="cuda")
    assert (rgb - want[0]).abs().mean() < 1e-4 and (alpha - want[1]).abs().mean() < 1e-4
    for k, y in want[2].items():
        assert (gradients[k] - y).norm() < 1e-2 * y.norm(), k
