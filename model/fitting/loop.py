# SPDX-License-Identifier: GPL-3.0-or-later
"""Fitting a scene to its views by gradient descent, for a number of seconds: the loop that per-scene methods
share. What the scene is made of, and how, is the caller's; any `DynamicScene` scene or Gaussians4D will do."""

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

ALPHA_WEIGHT = 0.3  # of the error in alpha against that in colour
COARSE, COARSE_UNTIL = 160, 0.6  # longest side in pixels of what is drawn in this first part of the budget
PHOTO_SHARE = (0.2, 0.8)  # share of a step's views that are photographs, at the start and the end, beside extra views


@dataclass(frozen=True)
class Schedule:
    """How long a fit goes on, and what its steps draw."""

    seconds: float = 0.0
    steps: int | None = None  # exactly so many, in place of seconds: then the result is the same on every run
    max_steps: int | None = None  # time that is left after these stays unused
    batch: int = 2  # views of a step
    coarse_size: int | None = COARSE  # longest side in pixels of the pictures at first; None: as they are, always
    seed: int = 0

    def fraction(self, elapsed: float, done: int) -> float:
        """The share 0..1 of the budget that is spent after `elapsed` seconds and `done` steps."""
        spent, budget = (elapsed, self.seconds) if self.steps is None else (done, self.steps)
        if budget <= 0:
            return 1.0
        return min(max(spent / budget, done / self.max_steps if self.max_steps else 0.0), 1.0)


@dataclass
class Step:
    """What a loss sees of a step."""

    rgb: Tensor  # (B,H,W,3) rendered over `background`
    alpha: Tensor  # (B,H,W)
    views: Views  # the B views that were drawn
    background: Tensor  # (3,)
    scene: Gaussians4D | DynamicScene
    fraction: float  # of the budget spent, 0..1


@contextmanager
def gradients():
    """Gradients, even inside of `torch.inference_mode`. Tensors made out there must be cloned in here."""
    with torch.inference_mode(False), torch.enable_grad():
        yield


def photometric_loss(step: Step) -> Tensor:
    """() mean absolute error of colours and, at ALPHA_WEIGHT, of alpha."""
    error = (step.rgb - step.views.over(step.background)).abs().mean()
    return error + ALPHA_WEIGHT * (step.alpha - step.views.alpha).abs().mean()


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

    def __init__(self, views: Views, extra_views: Views | None, schedule: Schedule):
        count, self.extra, self.size = len(views), extra_views is not None, schedule.batch
        self.views = joined(views, extra_views) if self.extra else views
        self.coarse = downsampled(self.views, reduction(self.views, schedule.coarse_size or max(self.views.size)))
        self.generator = torch.Generator().manual_seed(schedule.seed)
        self.photographs = _Turns(0, count, self.generator)
        self.others = _Turns(count, len(self.views), self.generator)

    def take(self, fraction: float) -> tuple[Views, Tensor]:
        """-> the views, and the background (3,)."""
        count = self.size
        if self.extra:
            first, last = PHOTO_SHARE
            share = first + (last - first) * fraction
            count = int((torch.rand(self.size, generator=self.generator) < share).sum())
        chosen = self.photographs.take(count) + self.others.take(self.size - count)
        views = (self.coarse if fraction < COARSE_UNTIL else self.views)[chosen]
        return views, torch.rand(3, generator=self.generator).to(views.rgb)


class _Report:
    """Tells the callback about ten times a second how far a fit is; without one a bar shows on a terminal after two
    seconds."""

    def __init__(self, text: str, progress: Callable[[float, str], None] | None):
        self.text, self.progress, self.told = text, progress, 0.0
        self.bar = tqdm(total=100, desc=text, unit="%", delay=2, leave=False, disable=True if progress else None)

    def __call__(self, fraction: float, elapsed: float, done: int) -> None:
        if elapsed - self.told <= 0.1 and fraction < 1:
            return
        self.told = elapsed
        self.bar.update(math.floor(100 * fraction) - self.bar.n)
        if self.progress:
            self.progress(fraction, f"{self.text}, step {done}")


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
    after_backward: Callable[[int, float], None] | None = None,
    text: str = "optimising",
    progress: Callable[[float, str], None] | None = None,
) -> int:
    """Takes steps of Adam as `schedule` says; returns how many.

    A step draws `scene()` from a few of the views over a random colour, and descends on `loss(step)`. `extra_views`,
    where given, make up the rest of a step's share PHOTO_SHARE of `views`. `after_backward(number, fraction)` may
    change the parameters' rows after a step, while their gradients are still there. `progress(fraction, text)` is
    called about ten times a second. Call inside of `gradients()`, with views from `detached`."""
    batches = _Batches(views, extra_views, schedule)
    if schedule.steps is None:
        warm_up(views.rgb.device.type)
    start, done = work_clock(), 0
    report = _Report(text, progress)
    while True:
        elapsed = work_clock() - start
        fraction = schedule.fraction(elapsed, done)
        report(fraction, elapsed, done)
        if fraction >= 1:
            report.bar.close()
            return done
        seen, background = batches.take(fraction)
        loss(draw(scene(), seen, background, fraction)).backward()
        done += 1
        if after_backward:
            after_backward(done, fraction)
        parameters.step(fraction)


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
