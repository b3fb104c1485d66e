# SPDX-License-Identifier: GPL-3.0-or-later
"""Budgets: what they say, that they are kept, and that a simple scene gets fewer Gaussians than a rich one."""

from itertools import pairwise

import pytest
import torch

from timesplat.cli import main
from timesplat.datagen.sequence import InputError
from timesplat.model.fitting import budget
from timesplat.model.fitting.budget import fewest, parse, reduced
from timesplat.model.fitting.merge import contribution
from timesplat.model.fitting.refine import error
from timesplat.model.geometry.lift import lift
from timesplat.model.io.ply import read_ply
from timesplat.model.reconstruct import reconstruct_views


@pytest.fixture(scope="module")
def scene(spheres):
    inputs = spheres(list(range(24)), size=48)
    others = spheres(list(range(1, 24, 3)), [(45 + 90 * (i % 4), 15) for i in range(8)], size=48)
    return inputs, others


def test_what_a_budget_says():
    assert parse("auto") is None and parse("700") == 700 and parse("10%") == 0.1 and parse("2.5%") == 0.025
    for wrong in ("", "0", "-3", "1.5", "0%", "101%", "few", "10 %"):
        with pytest.raises(InputError, match="a number of Gaussians"):
            parse(wrong)


@pytest.mark.parametrize("near", [False, True])
def test_a_share_is_kept_to(scene, near, monkeypatch, steady_clock):
    inputs, others = scene
    start = lift(inputs)
    monkeypatch.setattr(budget, "SECONDS", 1.0)
    g = reduced(start, inputs, "5%", near=near)
    assert 0 < len(g) <= 0.05 * len(start)
    assert error(g, others) < 0.5 * error(g[:0], others)


def test_a_fit_that_ends_early_keeps_to_the_number_too(scene, monkeypatch):
    """It may have split Gaussians and not yet dropped others: those that show most stay."""
    inputs, _ = scene
    start = lift(inputs)[::7]
    monkeypatch.setattr(budget, "refine", lambda g, *args, **options: g)
    g = reduced(start, inputs, "50", near=True)
    shown = contribution(start, budget.around(start, budget.own(inputs)))
    assert len(g) == 50 and torch.equal(g.xyz, start.xyz[shown.topk(50).indices])


def test_the_search_ends_where_twice_as_many_are_no_better(scene, monkeypatch):
    inputs, _ = scene
    start = lift(inputs)
    monkeypatch.setattr(budget, "FEWEST", 50)
    monkeypatch.setattr(budget, "fit", lambda *_, most, **__: (0.0, most))
    found, scenes = [], {"needs": 0.0}
    monkeypatch.setattr(budget, "error", lambda most, views: 1e-3 + scenes["needs"] / most**2)
    for scenes["needs"] in (1e-9, 1, 100):
        n, tried = fewest(start, inputs, 0.1, near=False)
        found.append(n)
        assert [k for k, _ in tried] == [50 * 2**i for i in range(len(tried))]
        gain = [b[1] - a[1] for a, b in pairwise(tried)]
        assert gain[-1] <= 0.1 and all(x > 0.1 for x in gain[:-1]) and n == tried[-2][0]
    assert found[0] == 50 and found[0] < found[1] < found[2]
    scenes["needs"] = 1e9
    assert fewest(start, inputs, 0.1, near=False)[0] > len(start) / 2
    assert fewest(start[:40], inputs, 0.1, near=False) == (int(start[:40].alive().sum()), [])
    with pytest.raises(InputError, match="give more than 0"):
        fewest(start, inputs, 0.0, near=False)


def test_the_search_as_it_is_used(scene, monkeypatch, steady_clock):
    inputs, _ = scene
    monkeypatch.setattr(budget, "TRIAL", 0.2)
    told = []
    n, tried = fewest(lift(inputs), inputs, 1.0, near=True, progress=lambda f, text: told.append(f))
    assert n in (tried[-2][0], tried[-1][0]) and told == sorted(told) and all(10 < db < 60 for _, db in tried)


def test_as_part_of_a_reconstruction_and_from_the_command_line(
    scene, write_views, tmp_path, capsys, monkeypatch, steady_clock
):
    inputs, others = scene
    monkeypatch.setattr(budget, "SECONDS", 0.3)
    monkeypatch.setattr(budget, "TRIAL", 0.1)
    with torch.inference_mode():
        assert len(reconstruct_views(inputs, "lift", budget="300")) <= 300
    folder = tmp_path / "spheres"
    write_views(inputs, folder, others)
    args = ["reconstruct", str(folder), "--method", "hull", "--out", str(tmp_path / "a.ply")]
    assert main([*args, "--budget", "some"]) == 2
    assert "a number of Gaussians, a share such as 10%, or auto" in capsys.readouterr().err
    assert main([*args, "--budget", "150"]) == 0
    assert len(read_ply(tmp_path / "a.ply")) <= 150
    assert main([*args, "--budget", "auto", "--max-loss", "3"]) == 0
    assert main([*args, "--budget", "auto", "--max-loss", "0"]) == 2
    with pytest.raises(InputError, match="of another kind"):
        reduced(object(), inputs, "10%", near=False)
