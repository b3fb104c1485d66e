# SPDX-License-Identifier: GPL-3.0-or-later
"""Fitting a scene to its views by gradient descent, for a number of seconds: the loop that per-scene methods
share. What the scene is made of, and how, is the caller's; any `DynamicScene` or Gaussians4D will do.

The parameters are rows of raw tensors with Adam's moments beside, so that Gaussians can be added and taken
away between steps.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache

import torch
import torch.nn.functional as F
from torch import Tensor
from tqdm import tqdm

from ..gaussians import DynamicScene, Gaussians4D
from ..parallel import work_clock
from ..rasterize import render
from ..views import Views, pad_to_multiple

BETAS, EPSILON = (0.9, 0.99), 1e-10  # Adam's; a shorter memory than usual, for hundreds of steps
MASK = 0.3  # weight of the error in alpha against that in colour
COARSE, COARSE_UNTIL = 160, 0.6  # longest side in pixels of what is drawn in this first part of the budget
OWN = (0.2, 0.8)  # share of a step's views that are photographs, at the start and at the end, where there are others


class Parameters:
    """Raw tensors by name, each with Adam's moments and a learning rate that decays exponentially.

    `parameters[name]` is the leaf that gradients reach."""

    def __init__(self, values: dict[str, Tensor], rates: dict[str, tuple[float, float]]):
        """values: name -> tensor of any shape; rates: name -> learning rate at the start and at the end of the
        budget."""
        self.rates = rates
        self.values = {k: v.detach().clone().requires_grad_() for k, v in values.items()}
        self.moments = {k: (torch.zeros_like(v), torch.zeros_like(v)) for k, v in self.values.items()}
        self.steps = 0

    def __getitem__(self, name: str) -> Tensor:
        return self.values[name]

    @torch.no_grad()
    def step(self, fraction: float) -> None:
        """One step of Adam (Kingma and Ba 2015) along the gradients, `fraction` 0..1 of the budget being spent.
        Entries whose gradient is not finite count as 0."""
        self.steps += 1
        a, b = BETAS
        for k, v in self.values.items():
            first, last = self.rates[k]
            if v.grad is None or first == 0:
                continue
            g, (m, s) = v.grad.nan_to_num_(0, 0, 0), self.moments[k]
            m.lerp_(g, 1 - a)
            s.mul_(b).addcmul_(g, g, value=1 - b)
            scale = first * (last / first) ** fraction / (1 - a**self.steps)
            v.addcdiv_(m, (s / (1 - b**self.steps)).sqrt_().add_(EPSILON), value=-scale)
            v.grad = None

    @torch.no_grad()
    def rows(self, keep: Tensor, names=None) -> None:
        """Keeps the rows `keep` (index or mask, repeats allowed) of the tensors `names` (all by default), with
        their gradients and moments."""
        for k in names or self.values:
            old = self.values[k]
            self.values[k] = old.detach()[keep].clone().requires_grad_()
            self.values[k].grad = None if old.grad is None else old.grad[keep]
            self.moments[k] = tuple(m[keep].clone() for m in self.moments[k])

    @torch.no_grad()
    def forget(self, rows: Tensor, names=None) -> None:
        """Sets Adam's moments of these rows to 0, as for newly made ones."""
        for k in names or self.values:
            for m in self.moments[k]:
                m[rows] = 0


class Turns:
    """Numbers first..last-1, all in turn, in a new random order each time."""

    def __init__(self, first: int, last: int, generator: torch.Generator):
        self.first, self.last, self.generator, self.order = first, last, generator, []

    def take(self, n: int) -> list[int]:
        while len(self.order) < n:
            order = torch.randperm(self.last - self.first, generator=self.generator)
            self.order += [self.first + i for i in order.tolist()]
        taken, self.order = self.order[:n], self.order[n:]
        return taken


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


def own(views: Views, device="cpu") -> Views:
    """The views' colour, alpha, cameras and times copied to a device: free of inference mode."""
    names = ("rgb", "alpha", "c2w", "intrinsics", "time")
    return replace(views, depth=None, flow=None, **{k: getattr(views, k).to(device).clone() for k in names})


def joined(a: Views, b: Views) -> Views:
    """The views of `a`, then those of `b`, of the same size; as from `own`."""
    names = ("rgb", "alpha", "c2w", "intrinsics", "time")
    return replace(a, **{k: torch.cat([getattr(a, k), getattr(b, k)]) for k in names})


def photographs(step: Step) -> Tensor:
    """Mean absolute error of colours and, at MASK of its weight, of alpha."""
    error = (step.rgb - step.views.over(step.background)).abs().mean()
    return error + MASK * (step.alpha - step.views.alpha).abs().mean()


def shrunk(views: Views, by: int) -> Views:
    """The views (without depth and flow) at 1/by of their size, rounded up; colours averaged as light is."""
    if by == 1:
        return views
    views = pad_to_multiple(views, by)

    def mean(x: Tensor) -> Tensor:  # (V,H,W,C)
        return F.avg_pool2d(x.movedim(-1, 1), by).movedim(1, -1)

    a = views.alpha[..., None]
    alpha = mean(a)
    rgb = mean(views.rgb * a) / alpha.clamp_min(1e-6)
    return replace(views, rgb=rgb, alpha=alpha[..., 0], intrinsics=views.intrinsics / by)


@cache
def ready(device: str) -> None:
    """Draws one Gaussian and takes one step, so that whoever counts seconds afterwards does not count the compiling of
    the kernels: half a minute the first time after an installation, loading them then."""
    with gradients():
        picture, camera = torch.ones(1, 8, 8, 3), torch.tensor([[8.0, 8, 4, 4]])
        views = Views(picture, picture[..., 0], torch.eye(4)[None], camera, torch.zeros(1), 1.0).to(device)
        p = Parameters({"xyz": torch.tensor([[0, 0, 2.0]], device=device)}, {"xyz": (1e-3, 1e-3)})
        one, three, turn = (torch.ones(1, *n, device=device) for n in ((), (3,), (4,)))

        def scene() -> Gaussians4D:
            return Gaussians4D(p["xyz"], 0 * one, 0 * three, one, three, turn, 0.5 * three, 0.5 * one)

        optimise(p, scene, views, photographs, 0.0, steps=1, batch=1)
        render(scene(), views.c2w, views.intrinsics, views.time, 8, 8, inference=True)


def optimise(
    parameters: Parameters,
    scene: Callable[[], Gaussians4D | DynamicScene],
    views: Views,
    loss: Callable[[Step], Tensor],
    seconds: float,
    *,
    steps: int | None = None,
    enough: int | None = None,
    beside: Views | None = None,
    batch: int = 2,
    coarse: int = COARSE,
    edit: Callable[[int, float], None] | None = None,
    background: Tensor | None = None,
    seed: int = 0,
    text: str = "optimising",
    progress: Callable[[float, str], None] | None = None,
) -> int:
    """Takes steps of Adam until `seconds` are over, or exactly `steps` of them where given (then the result is
    the same on every run); returns how many.

    A step draws `scene()` from `batch` views (all views in turn, in random order) over `background` (3,) or
    a random colour, pictures larger than `coarse` pixels averaged down at first, and descends on `loss(step)`.
    After `enough` steps, where given, time that is left stays unused. Views `beside`, where given, make up the rest
    of a step's share OWN of `views`.
    `edit(number, fraction)` may change the parameters' rows after a step, while their gradients are still there.
    `progress(fraction, text)` is called about ten times a second; without it a bar shows on a terminal after
    two seconds. Call inside of `gradients()`, with views from `own`."""
    generator = torch.Generator().manual_seed(seed)
    count = len(views)
    views = joined(views, beside) if beside else views
    small = shrunk(views, -(-max(views.size) // coarse))
    turns = Turns(0, count, generator), Turns(count, len(views), generator)
    if steps is None:
        ready(views.rgb.device.type)
    start, told, done = work_clock(), 0.0, 0
    bar = tqdm(total=100, desc=text, unit="%", delay=2, leave=False, disable=True if progress else None)
    while True:
        elapsed = work_clock() - start
        spent, most = (elapsed, seconds) if steps is None else (done, steps)
        fraction = max(spent / most, done / enough if enough else 0.0) if most > 0 else 1.0
        fraction = min(fraction, 1.0)
        if elapsed - told > 0.1 or fraction >= 1:
            told = elapsed
            bar.update(math.floor(100 * fraction) - bar.n)
            if progress:
                progress(fraction, f"{text}, step {done}")
        if fraction >= 1:
            break
        share = OWN[0] + (OWN[1] - OWN[0]) * fraction
        mine = int((torch.rand(batch, generator=generator) < share).sum()) if beside else batch
        seen = (small if fraction < COARSE_UNTIL else views)[turns[0].take(mine) + turns[1].take(batch - mine)]
        height, width = seen.size
        behind = torch.rand(3, generator=generator).to(views.rgb) if background is None else background
        here = scene()
        rgb, alpha = render(here, seen.c2w, seen.intrinsics, seen.time, width, height, background=behind)
        loss(Step(rgb, alpha, seen, behind, here, fraction)).backward()
        done += 1
        if edit:
            edit(done, fraction)
        parameters.step(fraction)
    bar.close()
    return done
