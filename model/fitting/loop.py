# SPDX-License-Identifier: GPL-3.0-or-later
"""Fitting a scene to its views by gradient descent, for a number of steps or of seconds: the loop that per-scene
methods share. What the scene is made of, and how, is the caller's; any `DynamicScene` scene or Gaussians4D will do."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor
from tqdm import tqdm

from ..gaussians import DynamicScene, Gaussians4D
from ..parallel import work_clock
from ..rasterize import render
from ..views import Views
from .fit_views import downsampled, joined, reduction
from .parameters import Parameters
from .photometric import photometric_error
from .plan import PROBE_SHARE, Costs, Plan, TimedPlan

COARSE, COARSE_UNTIL = 160, 0.6  # longest side in pixels of what is drawn in this first part of the schedule
Pyramid = tuple[tuple[float, int], ...]  # up to which share of a schedule pictures have what longest side at the most
PROBES = 5  # steps at the most, of each size of pictures, by which the speed is measured
PHOTO_SHARE = (0.2, 0.8)  # share of a step's views that are photographs, at the start and the end, beside extra views


@dataclass(frozen=True)
class Schedule:
    """How long a fit goes on, and what its steps draw."""

    seconds: float = 0.0  # as many steps as fit, planned by the speed of the first
    steps: int | None = None  # exactly so many, in place of seconds: then the result is the same on every run
    max_steps: int | None = None  # time that is left after these stays unused
    batch: int = 2  # views of a step
    pyramid: Pyramid = ((COARSE_UNTIL, COARSE),)  # pictures are small at first; after the last share as they are
    seed: int = 0


@dataclass
class Step:
    """What a loss sees of a step."""

    rgb: Tensor  # (B,H,W,3) rendered over `background`
    alpha: Tensor  # (B,H,W)
    views: Views  # the B views that were drawn
    background: Tensor  # (3,)
    scene: Gaussians4D | DynamicScene
    fraction: float  # of the schedule that is done, 0..1


Choose = Callable[[float, int], list[int] | None]


@contextmanager
def gradients():
    """Gradients, even inside of `torch.inference_mode`. Tensors made out there must be cloned in here."""
    with torch.inference_mode(False), torch.enable_grad():
        yield


def photometric_loss(step: Step, ssim_weight: float = 0.0) -> Tensor:
    """() how far a step's pictures are from its views; see `photometric_error`."""
    return photometric_error(step.rgb, step.alpha, step.views, step.background, ssim_weight)


class _Turns:
    """Numbers first..last-1, all in turn, in a new random order each time."""

    def __init__(self, first: int, last: int, generator: torch.Generator):
        self.first, self.last, self.generator, self.order = first, last, generator, []

    def take(self, n: int) -> list[int]:
        while len(self.order) < n:
            order = torch.randperm(self.last - self.first, generator=self.generator)
            self.order += [self.first + i for i in order.tolist()]
        taken, self.order = self.order[:n], self.order[n:]
        return taken


class _Batches:
    """The views of each step, all in turn in random order, and what is behind them: a random colour. Of extra views
    there are fewer and fewer in a step."""

    def __init__(self, views: Views, extra_views: Views | None, schedule: Schedule, choose: Choose | None):
        self.choose = choose
        count, self.extra, self.size = len(views), extra_views is not None, schedule.batch
        self.views = joined(views, extra_views) if self.extra else views
        by = [(until, reduction(self.views, size)) for until, size in schedule.pyramid]
        self.levels = [(until, downsampled(self.views, n)) for until, n in by if n > 1] + [(1.0, self.views)]
        self.generator = torch.Generator().manual_seed(schedule.seed)
        self.photographs = _Turns(0, count, self.generator)
        self.others = _Turns(count, len(self.views), self.generator)

    def at(self, fraction: float) -> Views:
        """All views, of the size that is drawn at this share of the schedule."""
        return next((views for until, views in self.levels if fraction < until), self.views)

    def take(self, fraction: float) -> tuple[Views, Tensor]:
        """-> the views, and the background (3,)."""
        chosen = self.choose(fraction, self.size) if self.choose else None
        if chosen is None:
            chosen = self._in_turn(fraction)
        views = self.at(fraction)[chosen]
        return views, torch.rand(3, generator=self.generator).to(views.rgb)

    def _in_turn(self, fraction: float) -> list[int]:
        count = self.size
        if self.extra:
            first, last = PHOTO_SHARE
            share = first + (last - first) * fraction
            count = int((torch.rand(self.size, generator=self.generator) < share).sum())
        return self.photographs.take(count) + self.others.take(self.size - count)

    def probe(self, number: int, fraction: float) -> tuple[Views, Tensor]:
        """Views and background as above, of the `number`-th step of those by which the speed is measured; nothing is
        taken for it."""
        chosen = [(number * self.size + i) * 7919 % len(self.views) for i in range(self.size)]  # all over the clip
        views = self.at(fraction)[chosen]
        return views, views.rgb.new_full((3,), 0.5)


class _Report:
    """Tells the callback about ten times a second how far a fit is, and at once what is to be said of its plan; without
    one a bar shows on a terminal after two seconds."""

    def __init__(self, text: str, progress: Callable[[float, str], None] | None):
        self.text, self.progress, self.told = text, progress, 0.0
        self.bar = tqdm(total=100, desc=text, unit="%", delay=2, leave=False, disable=True if progress else None)

    def __call__(self, fraction: float, elapsed: float, done: int, steps: int) -> None:
        if elapsed - self.told <= 0.1 and fraction < 1:
            return
        self.told = elapsed
        self.bar.update(math.floor(100 * fraction) - self.bar.n)
        if self.progress:
            self.progress(fraction, f"{self.text}, step {done} of {steps}")

    def say(self, fraction: float, sentence: str) -> None:
        if self.progress and sentence:
            self.progress(fraction, f"{self.text}: {sentence}")


def draw(scene: Gaussians4D | DynamicScene, views: Views, background: Tensor, fraction: float) -> Step:
    """The scene as the views' cameras see it over `background` (3,), with gradients."""
    height, width = views.size
    camera = (views.c2w, views.intrinsics, views.time, width, height)
    rgb, alpha = render(scene, *camera, background=background)
    return Step(rgb, alpha, views, background, scene, fraction)


def optimise(
    parameters: Parameters,
    scene: Callable[[], Gaussians4D | DynamicScene],
    views: Views,
    loss: Callable[[Step], Tensor],
    schedule: Schedule,
    *,
    extra_views: Views | None = None,
    choose: Choose | None = None,
    grown: Callable[[float], Gaussians4D | DynamicScene] | None = None,
    planned: Callable[[int], bool] | None = None,
    after_backward: Callable[[int, float], object] | None = None,
    generator: torch.Generator | None = None,
    text: str = "optimising",
    progress: Callable[[float, str], None] | None = None,
) -> int:
    """Takes steps of Adam as `schedule` says; returns how many.

    A step draws `scene()` from a few of the views over a random colour, and descends on `loss(step)`. `extra_views`,
    where given, make up the rest of a step's share PHOTO_SHARE of `views`. `choose(fraction, count)` may say which of
    the views a step draws (indices), in place of all in turn in random order (None). `grown(fraction)` is the scene as
    large as it will be, where it grows much: what steps cost is measured with it. `planned(steps)` is told of how many
    there will be; where it says that the scene grows otherwise for it, they are measured and planned anew.
    `after_backward(number, fraction)`
    may change the parameters' rows after a step, while their gradients are still there. `generator` is what `scene` and
    `loss` take random numbers from, if they do: measuring the speed leaves it as it was. `progress(fraction, text)` is
    called about ten times a second, and with a line that has "planned" in it when steps are planned for seconds.
    Call inside of `gradients()`, with views from `detached`."""
    batches, report = _Batches(views, extra_views, schedule, choose), _Report(text, progress)
    timed = schedule.steps is None and schedule.seconds > 0
    if timed:
        warm_up(views.rgb.device.type)
    start, done, plan = work_clock(), 0, Plan(schedule.steps or 0)

    def timed_plan() -> TimedPlan:
        probing = PROBE_SHARE * schedule.seconds
        costs = _measured(parameters, grown or (lambda _: scene()), loss, batches, probing, generator)
        return TimedPlan(schedule.seconds, costs, work_clock() - start, schedule.max_steps)

    if timed:
        plan = timed_plan()
    if planned and planned(plan.steps) and timed:
        plan = timed_plan()
    if timed:
        report.say(0.0, f"planned {plan.steps:,} steps of {schedule.batch} views in {schedule.seconds:.3g} s")
    while True:
        elapsed = work_clock() - start
        sentence = plan.look(elapsed, done)
        fraction = plan.fraction(done)
        report.say(fraction, sentence)
        report(fraction, elapsed, done, plan.steps)
        if fraction >= 1:
            report.bar.close()
            return done
        seen, background = batches.take(fraction)
        loss(draw(scene(), seen, background, fraction)).backward()
        done += 1
        if after_backward:
            after_backward(done, fraction)
        parameters.step(fraction, plan.steps)


def _measured(
    parameters: Parameters,
    scene: Callable[[float], Gaussians4D | DynamicScene],
    loss: Callable[[Step], Tensor],
    batches: _Batches,
    seconds: float,
    generator: torch.Generator | None,
) -> Costs:
    """What a step costs with pictures of each size: the median of some, taken as far as their gradients,
    that leave parameters and random numbers as they were. They take about so many seconds, or a step."""
    device = batches.views.rgb.device
    state = generator.get_state() if generator else None

    def cost(fraction: float, seconds: float) -> float:
        taken: list[float] = []
        while len(taken) < PROBES and (not taken or sum(taken) + taken[-1] <= seconds):
            begun = work_clock()
            seen, background = batches.probe(len(taken), fraction)
            loss(draw(scene(fraction), seen, background, fraction)).backward()
            for value in parameters.values.values():
                value.grad = None
            if device.type == "cuda":
                torch.cuda.synchronize(device)
            taken.append(work_clock() - begun)
        return sorted(taken)[(len(taken) - 1) // 2]

    stages, since, pixels = [], 0.0, 0
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        for until, views in batches.levels:
            share = seconds / len(batches.levels)
            larger = views.alpha[0].numel() / pixels if stages else 1.0
            # Steps that would take too long are taken to cost by their pixels.
            expected = larger * stages[-1][1] if stages else 0.0
            stages.append((until, expected if expected > 2 * share else cost(since, share)))
            since, pixels = until, views.alpha[0].numel()
    if generator:
        generator.set_state(state)
    return Costs(tuple(stages))


@cache
def warm_up(device: str) -> None:
    """Draws one Gaussian and takes one step, so that whoever counts seconds afterwards does not count the compiling of
    the kernels: half a minute the first time after an installation, loading them then."""
    with gradients():
        picture, camera = torch.ones(1, 8, 8, 3), torch.tensor([[8.0, 8, 4, 4]])
        views = Views(picture, picture[..., 0], torch.eye(4)[None], camera, torch.zeros(1), 1.0).to(device)
        p = Parameters({"xyz": torch.tensor([[0, 0, 2.0]], device=device)}, {"xyz": (1e-3, 1e-3)})
        one, three, turn = (torch.ones(1, *n, device=device) for n in ((), (3,), (4,)))

        def scene() -> Gaussians4D:
            return Gaussians4D(p["xyz"], 0 * one, 0 * three, one, three, turn, 0.5 * three, 0.5 * one)

        optimise(p, scene, views, photometric_loss, Schedule(steps=1, batch=1))
        render(scene(), views.c2w, views.intrinsics, views.time, 8, 8, inference=True)
