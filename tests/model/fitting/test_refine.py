# SPDX-License-Identifier: GPL-3.0-or-later
"""Test-time refinement: better on views it never saw, the start where a fit goes wrong, refusals in one sentence."""

from dataclasses import replace

import pytest
import torch

from timesplat.cli import main
from timesplat.datagen.sequence import InputError, read_sequence
from timesplat.evaluation.loading import load_truth
from timesplat.evaluation.method_spec import parse_spec
from timesplat.evaluation.scoring import evaluate_views
from timesplat.model.fitting.fit_views import squared_error
from timesplat.model.fitting.loop import photometric_loss
from timesplat.model.fitting.refine import FROM_DEPTH, FROM_RGB, Few, part, refine, start_size
from timesplat.model.gaussians import Gaussians4D
from timesplat.model.geometry.lift import lift
from timesplat.model.io.ply import read_ply
from timesplat.model.views import load_views


@pytest.fixture(scope="module")
def scene(spheres):
    """Input views, one a frame and from four sides, and views from between these."""
    inputs = spheres(list(range(24)), size=48)
    others = spheres(list(range(1, 24, 3)), [(45 + 90 * (i % 4), 15) for i in range(8)], size=48)
    return inputs, others


def spoilt(g: Gaussians4D) -> Gaussians4D:
    """Moved by a few pixels, washed out, and half transparent."""
    generator = torch.Generator().manual_seed(0)
    xyz = g.xyz + 0.03 * torch.randn(g.xyz.shape, generator=generator)
    return replace(g, xyz=xyz, rgb=0.6 * g.rgb + 0.2, opacity=0.5 * g.opacity)


@pytest.mark.parametrize("has_depth", [False, True])
def test_other_views_get_better_by_a_number_of_steps(scene, has_depth):
    inputs, others = scene
    start = spoilt(lift(inputs))
    copy = start.map(torch.clone)
    with torch.inference_mode():
        told = []
        g = refine(start, inputs, 0, has_depth=has_depth, steps=30, progress=lambda f, text: told.append(f))
    assert squared_error(g, others) < (0.85 if has_depth else 0.6) * squared_error(start, others)
    assert g.alive().any() and all(torch.isfinite(x).all() for x in (g.xyz, g.scale, g.opacity))
    assert told[-1] == 1 and torch.equal(start.xyz, copy.xyz) and torch.equal(start.opacity, copy.opacity)
    again = refine(start, inputs, 0, has_depth=has_depth, steps=30)
    torch.testing.assert_close(again.xyz, g.xyz)


def test_what_gets_no_better_stays(scene, monkeypatch):
    inputs, _ = scene
    start = lift(inputs)
    monkeypatch.setattr("timesplat.model.fitting.refine.photometric_loss", lambda step: -photometric_loss(step))
    assert refine(start, inputs, 0, has_depth=True, steps=8) is start
    assert refine(start, inputs, 0.0) is start
    none = replace(start, opacity=0 * start.opacity)
    assert refine(none, inputs, 1.0) is none and refine(start[:0], inputs, 1.0).xyz.shape == (0, 3)


def test_rgb_starts_from_small_pictures(spheres):
    large = spheres(list(range(6)), size=200)
    assert start_size(large).size == (50, 50) and start_size(large).depth is None
    assert start_size(large[:5]).size == (200, 200)  # fewer are not fitted


def test_too_few_views_of_rgb_are_not_fitted(scene):
    inputs, _ = scene
    assert isinstance(refine(lift(inputs[:3]), inputs[:3], 0, steps=3, has_depth=True), Gaussians4D)
    start = lift(inputs[:5])
    assert refine(start, inputs[:5], 0, steps=3) is start


def test_limits_follow_the_pictures(spheres):
    views = spheres([0], size=64)
    assert FROM_RGB.limit(views) == 3000 and FROM_DEPTH.limit(views) == 2000
    assert Few.of(True) is FROM_DEPTH and Few.of(False) is FROM_RGB


@pytest.mark.parametrize("has_depth", [False, True])
def test_a_number_is_kept_even_where_the_start_was_better(scene, has_depth):
    inputs, others = scene
    start = lift(inputs)
    told = []
    g = refine(
        start, inputs, 0, has_depth=has_depth, steps=60, max_gaussians=200, progress=lambda f, text: told.append(f)
    )
    assert len(g) <= 200 < len(start) / 5 and squared_error(g, others) < 0.01
    assert told == sorted(told) and told[-1] == 1
    assert part(None, 0, 1) is None


def test_refusals(scene):
    inputs, _ = scene
    for seconds in (-1.0, float("nan"), float("inf")):
        with pytest.raises(InputError, match="seconds of refinement: give 0 or more"):
            refine(lift(inputs), inputs, seconds)
    with pytest.raises(InputError, match="of another kind"):
        refine(object(), inputs, 1.0)


def test_from_the_command_line_and_in_the_tables(scene, write_views, tmp_path, capsys, steady_clock):
    inputs, others = scene
    folder = tmp_path / "spheres"
    write_views(inputs, folder, others)
    args = ["reconstruct", str(folder), "--method", "hull", "--out", str(tmp_path / "a.ply")]
    assert main([*args, "--refine", "-1"]) == 2
    assert "give 0 or more" in capsys.readouterr().err
    assert main([*args, "--refine", "0.5"]) == 0
    assert len(read_ply(tmp_path / "a.ply")) > 100
    seq = read_sequence(folder)
    chosen = [i for i, v in enumerate(seq.views) if v.rig != "target"]
    targets = [i for i, v in enumerate(seq.views) if v.rig == "target"]
    views, truth = load_views(seq, chosen, False), load_truth(seq, targets, targets)
    row = {m: evaluate_views(views, parse_spec(m), truth)[0]["psnr"] for m in ("hull", "hull+refine:1")}
    assert row["hull+refine:1"] > row["hull"]
