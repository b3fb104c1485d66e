# SPDX-License-Identifier: GPL-3.0-or-later
"""Test-time refinement: predicted 4D Gaussians fitted to the input views for some steps, by gradient descent.

One view a moment says little about a scene, and is soon learnt by heart (33 dB on the inputs where other views
gain nothing any more). What keeps it from that:
    few, larger, longer-lived Gaussians, merged from those predicted: several views see each, and steps are quick;
    a prediction from depth and motion is drawn from all around first, and the few are fitted to these pictures as
    well as to the photographs, more and more to the latter;
    a weight on opacity, random backgrounds, and small pictures at first;
    of some states on the way, the best on a few input views is taken, and the start where none is better.
These views are fitted like the others, so that they tell where a fit goes wrong, not where it begins to overfit.
Held out, they said "stay" of an object that gained 3.5 dB elsewhere, even after merging: the start is made of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ...datagen.sequence import InputError
from ..gaussians import Gaussians4D, ReconstructedScene
from ..parallel import work_clock
from ..views import Views
from .densify import Densifier
from .fit_views import detached, downsampled, reduction, squared_error, validation_views, views_around
from .loop import COARSE_UNTIL, Schedule, Step, gradients, optimise, photometric_loss, warm_up
from .merge import merge_gaussians
from .parameters import RATES, Parameters, activate, raw_parameters

PIXELS = 128**2  # of a picture, to which seconds and numbers of Gaussians below refer
SMALL = 64  # longest side in pixels of what a prediction from RGB is made of before it is merged; fits begin with
# pictures of half the size, but no less: 0.1 dB and a fifth more steps
LOOKS = 6  # states on the way that are validated, the last one included
MERGED = 2 / 3  # of the Gaussians wanted are merged from those predicted; the others are split off where the fit pulls


@dataclass(frozen=True)
class Few:
    """How few Gaussians, merged from those predicted, are fitted."""

    max_gaussians: int  # beyond which refinement does not gain, for pictures of PIXELS
    grows: bool  # whether there may be more of them for larger pictures, in proportion to their sides
    opacity_weight: float  # in the loss, of mean opacity, times the share of the pictures that is object
    max_steps: int
    min_views: int  # fewer input views are learnt by heart
    min_sigma_t: float  # at the start
    fade: float  # of opacity at the start

    @staticmethod
    def of(has_depth: bool) -> Few:
        """Those for a prediction from depth and motion, or from RGB."""
        return FROM_DEPTH if has_depth else FROM_RGB

    def limit(self, views: Views) -> int:
        """Gaussians beyond which refinement to these views does not gain."""
        return round(self.max_gaussians * (enlargement(views) ** 0.5 if self.grows else 1.0))

    def merged(self, g: Gaussians4D, max_gaussians: int) -> dict[str, Tensor]:
        """Raw parameters of the Gaussians, merged from `g` (N,), that a fit of `max_gaussians` starts from."""
        return raw_parameters(merge_gaussians(g, max(int(MERGED * max_gaussians), 1)), self.min_sigma_t, self.fade)


FROM_RGB = Few(
    max_gaussians=3000,
    grows=False,
    opacity_weight=0.04,
    max_steps=1500,  # more learn the photographs by heart: after 4000, other views were worse by up to 0.2 dB
    min_views=6,  # with 4 other views lost 0.6 dB, with 8 they won 1.2
    min_sigma_t=0.25,  # an eighth of the clip: several views of one a frame
    fade=0.3,  # what hides the rest must not be there before it is known to be right
)
FROM_DEPTH = Few(
    max_gaussians=4000,
    grows=True,
    opacity_weight=0.02,
    max_steps=3000,  # after 1500 there were 0.0 to 0.3 dB left to win
    min_views=0,
    min_sigma_t=1e-6,
    fade=1.0,
)


@dataclass(frozen=True)
class All:
    """How all the Gaussians of a prediction from depth and motion are fitted, before they are merged: moved only a
    little."""

    rates: dict[str, tuple[float, float]]  # learning rates at the start and at the end
    enough: float  # seconds, for pictures of PIXELS, up to which they are never merged …
    enough_steps: int  # … or, where steps are given, so many
    share: float  # of more of them that come before they are merged …
    longest: float  # … and so many seconds at most …
    longest_steps: int  # … or steps

    def is_enough(self, seconds: float, steps: int | None, enlarged: float) -> bool:
        """Whether nothing is merged in so many seconds or steps, for pictures `enlarged` times PIXELS."""
        return seconds <= self.enough * enlarged if steps is None else steps <= self.enough_steps

    def part(self, seconds: float, steps: int | None, enlarged: float) -> float:
        """The share 0..1 of them that comes before merging."""
        most = self.longest * enlarged / max(seconds, 1e-9) if steps is None else self.longest_steps / max(steps, 1)
        return min(self.share, most)


# Places are right to a pixel. (Four times the rate of opacity, with a weight on it, won a little more on clouds of
# 75,000, and lost on larger ones, which take fewer steps.)
ALL = All(
    rates={
        "xyz": (2e-4, 2e-4),
        "t": (0.0, 0.0),
        "velocity": (1e-3, 1e-3),
        "sigma_t": (1e-2, 5e-3),
        "scale": (5e-3, 2e-3),
        "rotation": (0.0, 0.0),
        "rgb": (2e-3, 1e-3),
        "opacity": (3e-2, 1e-2),
    },
    enough=4.0,
    enough_steps=80,
    share=0.3,
    longest=3.0,
    longest_steps=60,
)


def check_seconds(seconds: float) -> None:
    """Raises InputError for what is no time to refine for."""
    if not (math.isfinite(seconds) and seconds >= 0):
        raise InputError(f"{seconds:g} seconds of refinement: give 0 or more.")


def enlargement(views: Views) -> float:
    """How many times PIXELS a picture has."""
    return views.alpha[0].numel() / PIXELS


def start_size(views: Views) -> Views:
    """The views, without depth and flow, at a size of at most SMALL pixels if refinement would fit them at all: after
    4 seconds, what a prediction from RGB was made of at 64² or 128² was the same to 0.1 dB, on four objects."""
    small = replace(views, depth=None, flow=None)
    return downsampled(small, reduction(views, SMALL)) if len(views) >= FROM_RGB.min_views else small


def part(progress, first: float, last: float):
    """The callback `progress(fraction, text)` (or None) of a part of what it reports, from `first` to `last`."""
    return progress and (lambda fraction, text: progress(first + (last - first) * fraction, text))


def refine(
    start: Gaussians4D | ReconstructedScene,
    views: Views,
    seconds: float = 0.0,
    device: str = "cpu",
    *,
    has_depth: bool = False,
    max_gaussians: int | None = None,
    steps: int | None = None,
    seed: int = 0,
    progress=None,
) -> Gaussians4D:
    """Gaussians (N,) and the input views that they are of -> refined Gaussians on the CPU, after `seconds` or exactly
    `steps`; `start` itself for zero seconds, for too few views of RGB, or where the validation views fit no better.
    has_depth: the start is made from depth and motion. max_gaussians: how many are wanted, 1 or more; the result
    has no more, even if it is worse. For `progress` see `optimise`.

    Raises InputError for a scene that is not of 4D Gaussians and for a wrong number of seconds."""
    check_seconds(seconds)
    if not isinstance(start, Gaussians4D):
        raise InputError("Refinement is of 4D Gaussians, and this method's scene is of another kind; leave it out.")
    few = Few.of(has_depth)
    too_few = len(views) < few.min_views and max_gaussians is None
    if (seconds == 0 and not steps) or not len(start) or too_few:
        return start
    warm_up(device)
    began = work_clock()
    with gradients():
        g = start.map(lambda x: x.detach().to(device).clone())
        g = g[g.alive()].with_axes()
        if not len(g):
            return start
        views = detached(views, device)
        start_error, better = squared_error(g, views[validation_views(views)]), None
        enlarged = enlargement(views)
        merging = not has_depth or max_gaussians is not None or not ALL.is_enough(seconds, steps, enlarged)
        first = 0.0  # share of the budget that comes before merging
        if has_depth:
            first = ALL.part(seconds, steps, enlarged) if merging else 1.0
            schedule = Schedule(
                seconds=first * seconds,
                steps=None if steps is None else round(first * steps),
                pyramid=(),
                seed=seed,
            )
            error, moved = fit(raw_parameters(g), ALL.rates, views, schedule, progress=part(progress, 0, first))
            if error < start_error:
                g = better = moved
        if merging:
            extra_views = views_around(g, views, seed) if has_depth else None
            schedule = Schedule(
                seconds=max(seconds - (work_clock() - began), 0.5 * (1 - first) * seconds),
                steps=None if steps is None else steps - round(first * steps),
                max_steps=few.max_steps,
                pyramid=((COARSE_UNTIL, max(-(-max(views.size) // 2), SMALL)),),
                seed=seed,
            )
            told = part(progress, first, 1)
            wanted = max_gaussians or few.limit(views)
            error, fitted = fit_few(g, wanted, few, views, schedule, extra_views=extra_views, progress=told)
            if error < start_error or max_gaussians is not None:
                better = fitted
        return start if better is None else better.to("cpu")


def fit_few(
    g: Gaussians4D,
    max_gaussians: int,
    few: Few,
    views: Views,
    schedule: Schedule,
    *,
    extra_views: Views | None = None,
    progress=None,
) -> tuple[float, Gaussians4D]:
    """No more than `max_gaussians`, merged from `g` (N,), fitted to the views (and to extra ones) as `few` says ->
    the error and the Gaussians of `fit`."""
    return fit(
        few.merged(g, max_gaussians),
        RATES,
        views,
        schedule,
        extra_views=extra_views,
        max_gaussians=max_gaussians,
        opacity_weight=few.opacity_weight,
        progress=progress,
    )


class Validation:
    """The best of a fit's states by its error on the validation views."""

    def __init__(self, views: Views):
        self.views = views[validation_views(views)]
        self.error, self.best, self.looks = math.inf, None, 0

    @torch.no_grad()
    def look(self, values: dict[str, Tensor]) -> None:
        """Keeps the Gaussians of these raw parameters if they are the best so far."""
        now = activate(values)
        error = squared_error(now, self.views)
        if error < self.error or self.best is None:
            self.error, self.best = error, now.map(torch.clone)

    def look_now_and_then(self, values: dict[str, Tensor], fraction: float) -> None:
        """Every LOOKS-th of the budget, of which `fraction` 0..1 is spent."""
        if fraction * LOOKS >= self.looks + 1:
            self.looks += 1
            self.look(values)


def fit(
    values: dict[str, Tensor],
    rates: dict[str, tuple[float, float]],
    views: Views,
    schedule: Schedule,
    *,
    extra_views: Views | None = None,
    max_gaussians: int | None = None,
    opacity_weight: float = 0.0,
    progress=None,
) -> tuple[float, Gaussians4D]:
    """Raw parameters fitted to views (and to extra ones) by `optimise` -> the best state's mean squared error on the
    validation views, and that state. max_gaussians: they are split up to this number; None: they stay as many as
    they are. opacity_weight: of mean opacity in the loss, times the share of the pictures that is object."""
    p, cover, validation = Parameters(values, rates), views.alpha.mean(), Validation(views)
    generator = torch.Generator().manual_seed(schedule.seed)
    densifier = Densifier(p, generator, max_gaussians) if max_gaussians else None

    def loss(step: Step) -> Tensor:
        weight = opacity_weight * cover
        return photometric_loss(step) + (weight * step.scene.opacity.mean() if opacity_weight else 0.0)

    def after_backward(number: int, fraction: float) -> None:
        if densifier:
            densifier.after_backward(number, fraction)
        validation.look_now_and_then(p.values, fraction)

    optimise(
        p,
        lambda: activate(p.values),
        views,
        loss,
        schedule,
        extra_views=extra_views,
        after_backward=after_backward,
        text="refining",
        progress=progress,
    )
    validation.look(p.values)
    return validation.error, validation.best
