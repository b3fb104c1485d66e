"""The instrument: what metrics.json holds, and that its figures are those of the pictures."""

import json

import numpy as np
import pytest
import torch

from timesplat.datagen.sequence import read_sequence
from timesplat.model.evaluate import COLUMNS, collect, draw, evaluate_folders, evaluate_method, summarise, table
from timesplat.model.metrics import psnr
from timesplat.model.views import load_views


def test_figures_are_those_of_the_pictures(sphere_folder):
    seq = read_sequence(sphere_folder)
    targets = seq.select(rig="target")
    row, g = evaluate_method(seq, "lift", list(range(24)), targets)
    truth = load_views(seq, targets)
    by_hand = psnr(draw(g, truth)[0], truth.over(1.0))
    assert row["psnr"] == pytest.approx(float(by_hand.mean()), abs=1e-5)
    assert row["psnr_worst"] == pytest.approx(float(by_hand.min()), abs=1e-5)
    assert row["gaussians_kept"] == len(g) <= row["gaussians"]


def test_metrics_json_has_the_promised_names(sphere_folder, tmp_path, capsys):
    seq = read_sequence(sphere_folder)
    evaluate_folders({"a": seq, "b": seq}, ["white", "lift"], tmp_path)
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert set(metrics) >= {"methods", "objects", "machine", "versions"}
    assert list(metrics["methods"]) == ["white", "lift"]
    assert set(metrics["objects"]["a"]["lift"]) == set(metrics["methods"]["lift"]) == set(COLUMNS)
    assert metrics["methods"]["lift"]["psnr"] > metrics["methods"]["white"]["psnr"]
    assert metrics["machine"]["cores"] >= 1 and metrics["versions"]["torch"]
    assert "| lift |" in (tmp_path / "metrics.md").read_text() and "| lift |" in capsys.readouterr().out


def test_white_scores_what_the_silhouette_says(sphere_folder):
    seq = read_sequence(sphere_folder)
    targets = seq.select(rig="target")
    row, g = evaluate_method(seq, "white", list(range(24)), targets)
    truth = load_views(seq, targets)
    assert len(g) == 0
    expected = psnr(torch.ones_like(truth.rgb), truth.over(1.0)).mean()
    assert row["psnr"] == pytest.approx(float(expected), abs=1e-5)


def test_means_are_over_views_and_percentiles_over_all():
    def rows(values):
        frames = {"psnr": values, "psnr_fg": values, "ssim": values}
        return {"m": summarise(frames) | {"seconds": 1.0, "gaussians": 2, "gaussians_kept": 1, "frames": frames}}

    m = collect({"a": rows([10.0, 20.0]), "b": rows([30.0, 40.0])})
    assert m["methods"]["m"]["psnr"] == 25 and m["methods"]["m"]["psnr_worst"] == 10
    assert m["methods"]["m"]["psnr_p5"] == pytest.approx(np.percentile([10, 20, 30, 40], 5))
    assert m["objects"]["b"]["m"]["psnr"] == 35
    assert table(m).count("\n") == 2
