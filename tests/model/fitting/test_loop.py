"""The optimisation loop: Adam as torch has it, rows that come and go, pictures averaged down, budgets."""

import pytest
import torch

from timesplat.model.fitting import loop as module
from timesplat.model.fitting.loop import BETAS, EPSILON, Parameters, gradients, optimise, own, photographs, shrunk
from timesplat.model.gaussians import Gaussians4D


def test_adam_is_torchs_and_rates_decay():
    torch.manual_seed(0)
    start, pull = torch.randn(5, 3), torch.randn(5, 3)
    p = Parameters({"a": start, "fixed": start}, {"a": (0.1, 0.001), "fixed": (0.0, 0.0)})
    theirs = torch.nn.Parameter(start.clone())
    adam = torch.optim.Adam([theirs], betas=BETAS, eps=EPSILON)
    for i in range(10):
        adam.param_groups[0]["lr"] = 0.1 * 0.01 ** (i / 10)
        for x in (theirs, p["a"]):
            ((x - pull) ** 2).sum().backward()
        adam.step()
        adam.zero_grad()
        p.step(i / 10)
    torch.testing.assert_close(p["a"], theirs, atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(p["fixed"].detach(), start, rtol=0, atol=0)


def test_rows_take_their_moments_along_and_nan_moves_nothing():
    p = Parameters({"a": torch.zeros(4), "b": torch.zeros(4, 2)}, {"a": (1.0, 1.0), "b": (1.0, 1.0)})
    (p["a"] * torch.arange(4.0)).sum().backward()
    p.rows(torch.tensor([3, 3, 1]))
    assert p["a"].grad.tolist() == [3, 3, 1] and p["b"].shape == (3, 2) and p["b"].grad is None
    p["a"].grad[2] = torch.nan
    p.step(0.0)
    assert p["a"].tolist() == [-1, -1, 0] and p["a"].requires_grad
    p.forget(torch.tensor([0]))
    assert p.moments["a"][0][0] == 0 and p.moments["a"][0][1] != 0


def test_shrunk_pictures_are_the_same_seen_smaller(spheres):
    large, small = spheres([5], [(30, 20)], size=96), spheres([5], [(30, 20)], size=32)
    got = shrunk(large, 3)
    assert got.size == (32, 32) and shrunk(large, 1) is large
    torch.testing.assert_close(got.intrinsics, small.intrinsics)
    torch.testing.assert_close(got.over(1.0).mean((0, 1, 2)), large.over(1.0).mean((0, 1, 2)))
    assert (got.over(1.0) - small.over(1.0)).abs().mean() < 0.02
    assert shrunk(spheres([5], size=50), 4).size == (13, 13)


@pytest.mark.parametrize("size", [24, 200])
def test_a_blob_finds_its_colour_within_inference_mode(spheres, size):
    with torch.inference_mode():
        views = spheres([0, 12], size=size)
        views.alpha = torch.ones_like(views.alpha)
        views.rgb = torch.tensor([0.2, 0.5, 0.7]).expand_as(views.rgb)
        with gradients():
            mine = own(views)
            p = Parameters({"rgb": torch.ones(1, 3)}, {"rgb": (0.1, 0.01)})
            one = torch.ones(1)

            def scene():
                turn = torch.tensor([[1.0, 0, 0, 0]])
                return Gaussians4D(
                    0 * p["rgb"], 0 * one, 0 * p["rgb"], 1e6 * one, torch.full((1, 3), 3.0), turn, p["rgb"], one
                )

            drawn = []
            done = optimise(p, scene, mine, lambda s: drawn.append(s.rgb.shape) or photographs(s), 0, steps=40)
    assert done == 40 and optimise(p, scene, mine, photographs, 0.0) == 0
    torch.testing.assert_close(p["rgb"].detach()[0], torch.tensor([0.2, 0.5, 0.7]), atol=0.05, rtol=0)
    assert drawn[0] == (2, min(size, 100), min(size, 100), 3) and drawn[-1] == (2, size, size, 3)
    with gradients():
        assert optimise(p, scene, mine, photographs, 1e9, enough=3) == 3


def test_seconds_are_those_of_the_steps_and_not_of_compiling(spheres, monkeypatch):
    """Each step takes a second of this clock, what makes the kernels ready a minute."""
    now, told = [0.0], []
    monkeypatch.setattr(module, "work_clock", lambda: now[0])
    monkeypatch.setattr(module, "ready", lambda device: now.append(now.pop() + 60))
    one = torch.ones(1)
    with gradients():
        views = own(spheres([0, 12], size=16))
        p = Parameters({"rgb": torch.ones(1, 3)}, {"rgb": (0.1, 0.01)})

        def scene():
            turn = torch.tensor([[1.0, 0, 0, 0]])
            return Gaussians4D(0 * p["rgb"], 0 * one, 0 * p["rgb"], one, torch.ones(1, 3), turn, p["rgb"], one)

        def loss(step):
            now[0] += 1
            return photographs(step)

        assert optimise(p, scene, views, loss, 8, progress=lambda fraction, text: told.append(fraction)) == 8
    assert told == [i / 8 for i in range(1, 9)]


def test_what_compiles_the_kernels_draws_and_steps(monkeypatch):
    drawn = []
    draw = module.render
    monkeypatch.setattr(module, "render", lambda *a, **k: drawn.append(draw(*a, **k)) or drawn[-1])
    with torch.inference_mode():
        module.ready.__wrapped__("cpu")
    assert len(drawn) == 2 and all(alpha.max() > 0.3 for _, alpha in drawn) and drawn[0][0].requires_grad
