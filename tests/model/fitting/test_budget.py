# SPDX-License-Identifier: GPL-3.0-or-later
"""Budgets: what they say, that they are kept, and that a simple scene gets fewer Gaussians than a rich one."""

import math
from itertools import pairwise

import pytest
import torch

from timesplat.cli import main
from timesplat.datagen.sequence import InputError
from timesplat.model.fitting import budget
from timesplat.model.fitting.budget import apply_budget, find_fewest, parse_budget
from timesplat.model.fitting.fit_views import squared_error
from timesplat.model.fitting.merge import contribution
from timesplat.model.geometry.lift import lift
from timesplat.model.io.ply import read_ply
from timesplat.model.methods import ReconstructOptions
from timesplat.model.reconstruct import reconstruct_views


@pytest.fixture(scope="module")
def scene(spheres):
    inputs = spheres(list(range(24)), size=48)
    others = spheres(list(range(1, 24, 3)), [(45 + 90 * (i % 4), 15) for i in range(8)], size=48)
    return inputs, others


def test_what_a_budget_says():
    assert (
        parse_budget("auto") is None
        and parse_budget("700") == 700
        and parse_budget("10%") == 0.1
        and parse_budget("2.5%") == 0.025
    )
    for wrong in ("", "0", "-3", "1.5", "0%", "101%", "few", "10 %"):
        with pytest.raises(InputError, match="a number of Gaussians"):
            parse_budget(wrong)


@pytest.mark.parametrize("has_depth", [False, True])
def test_a_share_is_kept_to(scene, has_depth, monkeypatch, steady_clock):
    inputs, others = scene
    start = lift(inputs)
    monkeypatch.setattr(budget, "SECONDS", 1.0)
    g = apply_budget(start, inputs, "5%", has_depth=has_depth)
    assert 0 < len(g) <= 0.05 * len(start)
    assert squared_error(g, others) < 0.5 * squared_error(g[:0], others)


def test_a_fit_that_ends_early_keeps_to_the_number_too(scene, monkeypatch):
    """It may have split Gaussians and not yet dropped others: those that show most stay."""
    inputs, _ = scene
    start = lift(inputs)[::7]
    monkeypatch.setattr(budget, "refine", lambda g, *args, **options: g)
    g = apply_budget(start, inputs, "50", has_depth=True)
    shown = contribution(start, budget.views_around(start, budget.detached(inputs)))
    assert len(g) == 50 and torch.equal(g.xyz, start.xyz[shown.topk(50).indices])


def test_the_search_ends_where_twice_as_many_are_no_better(scene, monkeypatch):
    inputs, _ = scene
    start = lift(inputs)
    monkeypatch.setattr(budget, "FIRST_TRY", 50)
    monkeypatch.setattr(budget, "fit_few", lambda g, number, *_, **__: (0.0, number))
    found, scenes = [], {"needs": 0.0}
    monkeypatch.setattr(budget, "psnr", lambda number, views: -10 * math.log10(1e-3 + scenes["needs"] / number**2))
    for scenes["needs"] in (1e-9, 1, 100):
        n, tried = find_fewest(start, inputs, 0.1, has_depth=False)
        found.append(n)
        assert [k for k, _ in tried] == [50 * 2**i for i in range(len(tried))]
        gain = [b[1] - a[1] for a, b in pairwise(tried)]
        assert gain[-1] <= 0.1 and all(x > 0.1 for x in gain[:-1]) and n == tried[-2][0]
    assert found[0] == 50 and found[0] < found[1] < found[2]
    scenes["needs"] = 1e9
    assert find_fewest(start, inputs, 0.1, has_depth=False)[0] > len(start) / 2
    assert find_fewest(start[:40], inputs, 0.1, has_depth=False) == (int(start[:40].alive().sum()), [])
    with pytest.raises(InputError, match="give more than 0"):
        find_fewest(start, inputs, 0.0, has_depth=False)


def test_the_search_as_it_is_used(scene, monkeypatch, steady_clock):
    inputs, _ = scene
    monkeypatch.setattr(budget, "TRY_SECONDS", 0.2)
    told = []
    n, tried = find_fewest(lift(inputs), inputs, 1.0, has_depth=True, progress=lambda f, text: told.append(f))
    assert n in (tried[-2][0], tried[-1][0]) and told == sorted(told) and all(10 < db < 60 for _, db in tried)


def test_as_part_of_a_reconstruction_and_from_the_command_line(
    scene, write_views, tmp_path, capsys, monkeypatch, steady_clock
):
    inputs, others = scene
    monkeypatch.setattr(budget, "SECONDS", 0.3)
    monkeypatch.setattr(budget, "TRY_SECONDS", 0.1)
    with torch.inference_mode():
        assert len(reconstruct_views(inputs, "lift", ReconstructOptions(budget="300"))) <= 300
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
        apply_budget(object(), inputs, "10%", has_depth=False)
