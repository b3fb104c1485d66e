# SPDX-License-Identifier: GPL-3.0-or-later
"""The optimisation loop: small pictures first, so many steps, and seconds planned in steps by measuring a few."""

import pytest
import torch

from timesplat.model.fitting import loop as module
from timesplat.model.fitting.fit_views import detached
from timesplat.model.fitting.loop import Schedule, gradients, optimise, photometric_loss
from timesplat.model.fitting.parameters import Parameters
from timesplat.model.gaussians import Gaussians4D


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


ONE = torch.ones(1)


def blob(p: Parameters) -> Gaussians4D:
    turn = torch.tensor([[1.0, 0, 0, 0]])
    return Gaussians4D(0 * p["rgb"], 0 * ONE, 0 * p["rgb"], ONE, torch.ones(1, 3), turn, p["rgb"], ONE)


@pytest.fixture
def clock(monkeypatch):
    """The loop's clock, in a list: nothing but a test moves it."""
    now = [0.0]
    monkeypatch.setattr(module, "work_clock", lambda: now[0])
    return now


def test_seconds_are_those_of_the_steps_and_not_of_compiling(spheres, monkeypatch, clock):
    """Each step takes a second of this clock, the one that is measured too; what makes the kernels ready a minute."""
    told = []
    monkeypatch.setattr(module, "warm_up", lambda device: clock.append(clock.pop() + 60))
    with gradients():
        views = detached(spheres([0, 12], size=16))
        p = Parameters({"rgb": torch.ones(1, 3)}, {"rgb": (0.1, 0.01)})

        def loss(step):
            clock[0] += 1
            return photometric_loss(step)

        schedule = Schedule(seconds=8)
        steps = optimise(p, lambda: blob(p), views, loss, schedule, progress=lambda *said: told.append(said))
    assert steps == 7
    assert told[0] == (0, "optimising: planned 7 steps of 2 views in 8 s")
    assert told[1:] == [(i / 7, f"optimising, step {i} of 7") for i in range(8)]


def test_measuring_leaves_everything_as_it_was(spheres, clock):
    """A fit for seconds is bit for bit the fit of as many steps as it planned, its random numbers included; both sizes
    of pictures are measured, small ones several times."""
    made, views = [], detached(spheres([0, 4, 8, 12], size=200))
    for schedule in (Schedule(seconds=2.0), Schedule(steps=36)):
        sizes, generator = [], torch.Generator().manual_seed(3)
        torch.manual_seed(5)
        with gradients():
            p = Parameters({"rgb": torch.ones(1, 3)}, {"rgb": (0.1, 0.01)})

            def loss(step):
                sizes.append(step.rgb.shape[1])  # noqa: B023
                clock[0] += 0.02 if step.rgb.shape[1] == 100 else 0.1
                noise = torch.rand((), generator=generator) + torch.rand(())  # noqa: B023
                return photometric_loss(step) * noise

            steps = optimise(p, lambda: blob(p), views, loss, schedule, generator=generator)  # noqa: B023
        made.append((steps, p["rgb"].detach().clone(), torch.rand(2), torch.rand(2, generator=generator), sizes))
    (steps, *timed, sizes), (_, *counted, plain) = made
    assert steps == 36 and all(torch.equal(a, b) for a, b in zip(timed, counted, strict=True))
    assert sizes[len(sizes) - steps :] == plain and set(sizes[: len(sizes) - steps]) == {100, 200}


def test_a_step_that_takes_long_is_measured_once(spheres, clock):
    with gradients():
        views = detached(spheres([0, 12], size=200))
        p, drawn = Parameters({"rgb": torch.ones(1, 3)}, {"rgb": (0.1, 0.01)}), []

        def loss(step):
            drawn.append(step.rgb.shape[1])
            clock[0] += (step.rgb.shape[1] / 100) ** 2
            return photometric_loss(step)

        steps = optimise(p, lambda: blob(p), views, loss, Schedule(seconds=12))
    assert drawn[:2] == [100, 100] and len(drawn) == steps + 1 == 6  # 11 s of steps of 1, 1, 1, 4, 4


def test_what_compiles_the_kernels_draws_and_steps(monkeypatch):
    drawn = []
    draw = module.render
    monkeypatch.setattr(module, "render", lambda *a, **k: drawn.append(draw(*a, **k)) or drawn[-1])
    with torch.inference_mode():
        module.warm_up.__wrapped__("cpu")
    assert len(drawn) == 2 and all(alpha.max() > 0.3 for _, alpha in drawn) and drawn[0][0].requires_grad


def test_a_plan_is_made_by_the_scene_as_large_as_it_will_be(spheres, clock):
    """A step costs nothing now, and a second when the scene has grown; nothing of that scene is trained."""
    with gradients():
        views, told = detached(spheres([0, 12], size=200)), []
        p = Parameters({"rgb": torch.ones(1, 3)}, {"rgb": (0.1, 0.01)})

        def grown(fraction):
            told.append(fraction)
            clock[0] += 1 if fraction else 0.25
            return blob(p)

        said = []
        optimise(
            p,
            lambda: blob(p),
            views,
            photometric_loss,
            Schedule(seconds=100, max_steps=150),
            grown=grown,
            progress=lambda _, text: said.append(text),
        )
    assert set(told) == {0.0, module.COARSE_UNTIL}
    steps = (100 - told.count(0.0) / 4 - told.count(module.COARSE_UNTIL)) / (0.6 * 0.25 + 0.4)
    assert said[0] == f"optimising: planned {min(round(steps), 150)} steps of 2 views in 100 s" and steps > 150


def test_who_is_told_of_the_plan_may_make_the_scene_larger_and_is_planned_for_anew(spheres, clock):
    with gradients():
        views = detached(spheres([0, 12], size=100))
        p, told, cost = Parameters({"rgb": torch.ones(1, 3)}, {"rgb": (0.1, 0.01)}), [], [1.0]

        def loss(step):
            clock[0] += cost[0]
            return photometric_loss(step)

        def planned(steps):
            told.append(steps)
            cost[0] = 2.0
            return True

        steps = optimise(p, lambda: blob(p), views, loss, Schedule(seconds=100), planned=planned)
        assert told == [95] and 44 <= steps <= 46  # of 100 s, five of a second and two of two are measured first
        optimise(p, lambda: blob(p), views, loss, Schedule(steps=3), planned=planned)
    assert told == [95, 3]
