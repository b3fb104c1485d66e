# SPDX-License-Identifier: GPL-3.0-or-later
"""The optimisation loop: small pictures first, budgets in seconds and in steps."""

import pytest
import torch

from timesplat.model.fitting import loop as module
from timesplat.model.fitting.fit_views import detached
from timesplat.model.fitting.loop import Schedule, gradients, optimise, photometric_loss
from timesplat.model.fitting.parameters import Parameters
from timesplat.model.gaussians import Gaussians4D


def test_a_schedule_says_what_share_is_spent():
    assert Schedule(seconds=4).fraction(1.0, 99) == 0.25 and Schedule(seconds=4).fraction(9.0, 0) == 1
    assert Schedule(seconds=4, steps=10).fraction(99.0, 5) == 0.5 and Schedule().fraction(0.0, 0) == 1
    assert Schedule(seconds=4, max_steps=10).fraction(1.0, 5) == 0.5


@pytest.mark.parametrize("size", [24, 200])
def test_a_blob_finds_its_colour_within_inference_mode(spheres, size):
    with torch.inference_mode():
        views = spheres([0, 12], size=size)
        views.alpha = torch.ones_like(views.alpha)
        views.rgb = torch.tensor([0.2, 0.5, 0.7]).expand_as(views.rgb)
        with gradients():
            mine = detached(views)
            p = Parameters({"rgb": torch.ones(1, 3)}, {"rgb": (0.1, 0.01)})
            one = torch.ones(1)

            def scene():
                turn = torch.tensor([[1.0, 0, 0, 0]])
                return Gaussians4D(
                    0 * p["rgb"], 0 * one, 0 * p["rgb"], 1e6 * one, torch.full((1, 3), 3.0), turn, p["rgb"], one
                )

            drawn = []
            done = optimise(
                p, scene, mine, lambda s: drawn.append(s.rgb.shape) or photometric_loss(s), Schedule(steps=40)
            )
    assert done == 40 and optimise(p, scene, mine, photometric_loss, Schedule()) == 0
    torch.testing.assert_close(p["rgb"].detach()[0], torch.tensor([0.2, 0.5, 0.7]), atol=0.05, rtol=0)
    assert drawn[0] == (2, min(size, 100), min(size, 100), 3) and drawn[-1] == (2, size, size, 3)
    with gradients():
        assert optimise(p, scene, mine, photometric_loss, Schedule(seconds=1e9, max_steps=3)) == 3


def test_seconds_are_those_of_the_steps_and_not_of_compiling(spheres, monkeypatch):
    """Each step takes a second of this clock, what makes the kernels ready a minute."""
    now, told = [0.0], []
    monkeypatch.setattr(module, "work_clock", lambda: now[0])
    monkeypatch.setattr(module, "warm_up", lambda device: now.append(now.pop() + 60))
    one = torch.ones(1)
    with gradients():
        views = detached(spheres([0, 12], size=16))
        p = Parameters({"rgb": torch.ones(1, 3)}, {"rgb": (0.1, 0.01)})

        def scene():
            turn = torch.tensor([[1.0, 0, 0, 0]])
            return Gaussians4D(0 * p["rgb"], 0 * one, 0 * p["rgb"], one, torch.ones(1, 3), turn, p["rgb"], one)

        def loss(step):
            now[0] += 1
            return photometric_loss(step)

        schedule = Schedule(seconds=8)
        assert optimise(p, scene, views, loss, schedule, progress=lambda fraction, text: told.append(fraction)) == 8
    assert told == [i / 8 for i in range(1, 9)]


def test_what_compiles_the_kernels_draws_and_steps(monkeypatch):
    drawn = []
    draw = module.render
    monkeypatch.setattr(module, "render", lambda *a, **k: drawn.append(draw(*a, **k)) or drawn[-1])
    with torch.inference_mode():
        module.warm_up.__wrapped__("cpu")
    assert len(drawn) == 2 and all(alpha.max() > 0.3 for _, alpha in drawn) and drawn[0][0].requires_grad
