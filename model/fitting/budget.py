# SPDX-License-Identifier: GPL-3.0-or-later
"""No more Gaussians than a scene needs: a number, a share of those predicted, or as many as keep within a loss.

The Gaussians wanted are merged from those predicted and fitted for some seconds (`refine.py`), so that a budget
costs quality only where the scene has more in it. `auto` looks for the fewest: short fits with more and more of
them, until twice as many would not bring the loss that is allowed back, on input views that were held out.
"""

from __future__ import annotations

import re

import torch

from ...datagen.sequence import InputError
from ..gaussians import Gaussians4D, ReconstructedScene
from ..views import Views
from .fit_views import detached, psnr, set_aside, views_around
from .loop import Schedule, gradients
from .merge import contribution
from .refine import Few, enlargement, fit_few, part, refine

SECONDS = 5.0  # of fitting, where none are asked for, at 128²; in proportion to the pixels above
FIRST_TRY = 500  # Gaussians; then twice as many, and so on
TRY_SECONDS, TRY_STEPS = 1.5, 150  # of each; the steps where nothing else goes by the clock either
MIN_CONTRIBUTION = 1.0  # pixels of a Gaussian in all of the pictures from around together: a twentieth have less


def parse_budget(text: str) -> int | float | None:
    """A number as it is, a share "P%" as P / 100, "auto" as None. Raises InputError for anything else."""
    if text == "auto":
        return None
    match = re.fullmatch(r"(\d+(?:\.\d+)?)(%?)", text)
    value = float(match[1]) if match else 0.0
    if match and match[2] and 0 < value <= 100:
        return value / 100
    if match and not match[2] and value >= 1 and value == int(value):
        return int(value)
    raise InputError(f"{text}: no budget; give a number of Gaussians, a share such as 10%, or auto.")


def check_loss(max_loss: float) -> None:
    """Raises InputError for dB that are not above 0."""
    if not max_loss > 0:
        raise InputError(f"{max_loss:g} dB of loss: give more than 0.")


def apply_budget(
    start: Gaussians4D | ReconstructedScene,
    views: Views,
    budget: str,
    seconds: float = 0.0,
    *,
    has_depth: bool,
    max_loss: float = 0.1,
    steps: int | None = None,
    seed: int = 0,
    device: str = "cpu",
    progress=None,
) -> Gaussians4D:
    """A prediction `start` (N,) from these views (has_depth: with depth and motion) -> no more Gaussians than `budget`
    says, refined by `steps`, or for `seconds`, or SECONDS where 0; nor more than refinement uses by itself, but for
    auto, which keeps within `max_loss` dB. Raises InputError, also for a scene that is not of 4D Gaussians."""
    wanted, search = parse_budget(budget), 0.0
    if wanted is None and isinstance(start, Gaussians4D):
        search = 0.5  # of what is reported
        told = part(progress, 0, search)
        tries = None if steps is None else TRY_STEPS
        how = {"has_depth": has_depth, "device": device, "progress": told, "steps": tries, "seed": seed}
        wanted, _ = find_fewest(start, views, max_loss, **how)
    elif isinstance(start, Gaussians4D):
        share = wanted * int(start.alive().sum()) if isinstance(wanted, float) else wanted
        wanted = max(min(int(share), Few.of(has_depth).limit(views)), 1)
    told = part(progress, search, 1)
    seconds = seconds or SECONDS * max(enlargement(views), 1.0)
    how_long = {"seconds": seconds if steps is None else 0.0, "steps": steps, "seed": seed}
    g = refine(start, views, device=device, has_depth=has_depth, max_gaussians=wanted, progress=told, **how_long)
    with gradients():
        g = g.map(torch.clone)
        if len(g) == 0:
            return g
        seen = contribution(g, views_around(g, detached(views)))
        if wanted and len(g) > wanted:  # a fit that was cut short had split some and not yet dropped others
            keep = seen.topk(wanted).indices
            g, seen = g[keep], seen[keep]
        return g[seen > MIN_CONTRIBUTION]


def find_fewest(
    start: Gaussians4D,
    views: Views,
    max_loss: float,
    *,
    has_depth: bool,
    steps: int | None = None,
    seed: int = 0,
    device: str = "cpu",
    progress=None,
) -> tuple[int, list[tuple[int, float]]]:
    """-> the fewest Gaussians that come within `max_loss` dB of twice as many, after fits of `steps`, or of
    TRY_SECONDS, on views set aside; and what was tried: (number, PSNR in dB there). Raises
    InputError for a `max_loss` that is not above 0."""
    check_loss(max_loss)
    with gradients():
        g = start.map(lambda x: x.detach().to(device).clone())
        g, views = g[g.alive()].with_axes(), detached(views, device)
        fitted, unseen = set_aside(views)
        extra_views = views_around(g, views) if has_depth else None
        schedule = Schedule(seconds=TRY_SECONDS, steps=steps, pyramid=(), seed=seed)
        tried: list[tuple[int, float]] = []
        number = FIRST_TRY
        while number < len(g):
            told = part(progress, 1 - 0.7 ** len(tried), 1 - 0.7 ** (len(tried) + 1))
            few = Few.of(has_depth)
            _, scene = fit_few(g, number, few, fitted, schedule, extra_views=extra_views, progress=told)
            tried.append((number, psnr(scene, unseen)))
            if len(tried) > 1 and tried[-1][1] - tried[-2][1] <= max_loss:
                return tried[-2][0], tried
            number *= 2
        return (tried[-1][0] if tried else len(g)), tried
