# SPDX-License-Identifier: GPL-3.0-or-later
"""The registry: a new metric is one entry, and appears wherever figures do."""

import numpy as np
import pytest
import torch

from timesplat.evaluation import metrics
from timesplat.evaluation.loading import Truth
from timesplat.evaluation.metrics import COLUMNS, METRICS, Metric, Pictures, measure, summarise
from timesplat.model.views import Views


@pytest.fixture
def pictures():
    torch.manual_seed(0)
    rgb, alpha = torch.rand(3, 16, 16, 3), torch.ones(3, 16, 16)
    views = Views(rgb, alpha, torch.eye(4).expand(3, 4, 4), torch.ones(3, 4), torch.zeros(3), 1.0)
    return Pictures(rgb + 0.1, alpha, Truth(views, rgb, torch.tensor([True, False, True])))


def test_columns_are_the_promised_names():
    assert COLUMNS[:8] == ["psnr", "psnr_p5", "psnr_worst", "psnr_fg", "psnr_fg_p5", "psnr_fg_worst", "ssim", "lpips"]
    assert COLUMNS[8:] == [
        *("novel_psnr", "novel_psnr_p5", "novel_psnr_worst", "novel_psnr_fg", "novel_ssim", "novel_lpips", "flip")
    ]


def test_dear_metrics_are_of_novel_views_and_others_can_be_left_out(pictures):
    frames = measure(pictures, left_out=("ssim",))
    assert frames["novel"] == [True, False, True] and frames["ssim"] == [None] * 3
    assert frames["flip"][1] is None and frames["flip"][0] > 0
    assert frames["lpips"] == [None] * 3  # no weights are at hand
    assert frames["psnr"] == pytest.approx([-20 * np.log10(0.1)] * 3, abs=2)


def test_nothing_novel_is_no_figure():
    frames = {k: [1.0, 2.0] for k in METRICS} | {"novel": [False, False], "flip": [None, None]}
    out = summarise(frames)
    assert out["novel_psnr"] is None and out["flip"] is None and out["psnr"] == 1.5 and out["psnr_worst"] == 1.0


def test_a_new_metric_is_one_entry(pictures, monkeypatch):
    new = Metric("brightness", "Brightness", "brightness", 1, lambda p: p.rgb.mean((1, 2, 3)).tolist(), False, ("",))
    monkeypatch.setitem(METRICS, "brightness", new)
    monkeypatch.setattr(metrics, "COLUMNS", ["brightness", "brightness_p5", "brightness_worst", "novel_brightness"])
    frames = measure(pictures)
    out = summarise(frames)
    assert out["brightness_worst"] == max(frames["brightness"])  # the worst is the highest here
    assert out["novel_brightness"] == pytest.approx(np.mean(frames["brightness"][::2]))
