# SPDX-License-Identifier: GPL-3.0-or-later
"""Test-time refinement: predicted 4D Gaussians fitted to the input views for some seconds, by gradient descent.

One view a moment says little about a scene, and is soon learnt by heart (33 dB on the inputs where other views
gain nothing any more). What keeps it from that:
    few, larger, longer-lived Gaussians, fused from those predicted: several views see each, and steps are quick;
    a prediction from depth and motion is drawn from all around first, and the few are fitted to these pictures as
    well as to the photographs, more and more to the latter;
    a price on opacity, random backgrounds, and small pictures at first;
    of some states on the way, the best on a few input views is taken, and the start where none is better.
These views are fitted like the others, so that they tell where a fit goes wrong, not where it begins to overfit.
Held out, they said "stay" of an object that gained 3.5 dB elsewhere, even after fusing: the start is made of them.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ...datagen.rigs import spherical
from ...datagen.sequence import InputError, opengl_to_opencv
from ..baselines.four_dgs import EVERY, RATES, UNTIL, activate, densify
from ..gaussians import DynamicScene, Gaussians4D
from ..parallel import work_clock
from ..rasterize import render
from ..views import Views
from .loop import Parameters, Step, gradients, optimise, own, photographs, ready, shrunk
from .merge import fuse

PIXELS = 128**2  # of a picture, to which seconds and numbers of Gaussians below refer
SMALL = 64  # longest side in pixels of what a prediction from RGB is made of before it is fused; fits begin with
# pictures of half the size, but no less: 0.1 dB and a fifth more steps
JUDGES = 4  # input views that judge
LOOKS = 6  # states on the way that are judged, the last one included
FUSED = 2 / 3  # of the Gaussians wanted are fused from those predicted; the others are split off where the fit pulls

# A prediction from RGB:
FEW, PRICE = 3000, 0.04  # Gaussians; price of mean opacity in the loss, times the share of the pictures that is object
FEWEST = 6  # input views; fewer are learnt by heart: with 4 other views lost 0.6 dB, with 8 they won 1.2
ENOUGH = 1500  # steps; more learn the photographs by heart: after 4000, other views were worse by up to 0.2 dB
LIFE = 0.25  # least σ_t at the start, an eighth of the clip: several views of one a frame
FADE = 0.3  # of opacity at the start: what hides the rest must not be there before it is known to be right

# A prediction from depth and motion:
NEAR_FEW, NEAR_PRICE, NEAR_ENOUGH = 4000, 0.02, 3000  # after 1500 steps there were 0.0 to 0.3 dB left to win
ALL = 4.0  # seconds, times PIXELS, up to which its Gaussians are all kept, and moved only a little: some 80 steps
FIRST, LONGEST = 0.3, 3.0  # of more seconds this share, and so many at most, come before they are fused
AROUND = 96  # pictures of them from other sides
STEEPEST = 58  # degrees of elevation, up and down, of where these are taken
# Learning rates at the start and at the end, of the raw parameters, while all are kept: places are right to a pixel.
# (Four times the rate of opacity, with a price, won a little more on clouds of 75,000, and lost on larger ones, which
# take fewer steps.) Of the few: those of four_dgs.
NEAR = {
    "xyz": (2e-4, 2e-4),
    "t": (0.0, 0.0),
    "velocity": (1e-3, 1e-3),
    "sigma_t": (1e-2, 5e-3),
    "scale": (5e-3, 2e-3),
    "rotation": (0.0, 0.0),
    "rgb": (2e-3, 1e-3),
    "opacity": (3e-2, 1e-2),
}


def check_seconds(seconds: float) -> None:
    """Raises InputError for what is no time to refine for."""
    if not (math.isfinite(seconds) and seconds >= 0):
        raise InputError(f"{seconds:g} seconds of refinement: give 0 or more.")


def refine(
    start: Gaussians4D | DynamicScene,
    views: Views,
    seconds: float,
    device: str = "cpu",
    *,
    near: bool = False,
    count: int | None = None,
    steps: int | None = None,
    seed: int = 0,
    progress=None,
) -> Gaussians4D:
    """Gaussians and the input views that they are of -> refined Gaussians on the CPU, after `seconds` or exactly
    `steps`; `start` itself for zero seconds, for fewer than FEWEST views of RGB, or where the views that judge fit
    no better. `near`: the start knows depth and motion. count: how many Gaussians are wanted, 1 or more; the result
    has no more, even if it is worse. For `progress` see `optimise`.

    Raises InputError for a scene that is not of 4D Gaussians and for a wrong number of seconds."""
    check_seconds(seconds)
    if not isinstance(start, Gaussians4D):
        raise InputError("Refinement is of 4D Gaussians, and this method's scene is of another kind; leave it out.")
    if (seconds == 0 and not steps) or not len(start) or (len(views) < FEWEST and not near and count is None):
        return start
    ready(device)
    began = work_clock()
    with gradients():
        g = start.map(lambda x: x.detach().to(device).clone())
        g = g[g.alive()].with_axes()
        if not len(g):
            return start
        views = own(views, device)
        least, better, first = error(g, views[judging(views)]), None, 0.0
        larger = views.alpha[0].numel() / PIXELS
        fusing = not near or count is not None or seconds > ALL * larger
        if near:
            longest = LONGEST * larger / seconds if seconds else 1.0
            first = min(FIRST, longest) if fusing else 1.0  # share of the budget
            whole = None if steps is None else round(first * steps)
            e, moved = fit(
                raw(g), NEAR, views, first * seconds, steps=whole, seed=seed, progress=part(progress, 0, first)
            )
            if e < least:
                g = better = moved
        if fusing:
            most = count or limit(views, near)
            beside = around(g, views, seed) if near else None
            values, price = few(g, most, near)
            e, fitted = fit(
                values,
                RATES,
                views,
                max(seconds - (work_clock() - began), 0.5 * (1 - first) * seconds),
                beside=beside,
                most=most,
                price=price,
                enough=NEAR_ENOUGH if near else ENOUGH,
                coarse=max(-(-max(views.size) // 2), SMALL),
                steps=None if steps is None else steps - round(first * steps),
                seed=seed,
                progress=part(progress, first, 1),
            )
            if e < least or count is not None:
                better = fitted
        return start if better is None else better.to("cpu")


def few(g: Gaussians4D, count: int, near: bool) -> tuple[dict[str, Tensor], float]:
    """Raw parameters of the Gaussians that a fit of `count` starts from, fused from `g`; and their price."""
    fused = fuse(g, max(int(FUSED * count), 1))
    return (raw(fused), NEAR_PRICE) if near else (raw(fused, LIFE, FADE), PRICE)


def limit(views: Views, near: bool) -> int:
    """Gaussians beyond which refinement does not gain; with depth and motion in proportion to the pictures' sides."""
    return round(NEAR_FEW * (views.alpha[0].numel() / PIXELS) ** 0.5) if near else FEW


def start_size(views: Views) -> Views:
    """The views, without depth and flow, at a size of at most SMALL pixels if refinement would fit them at all: after
    4 seconds, what a prediction from RGB was made of at 64² or 128² was the same to 0.1 dB, on four objects."""
    small = replace(views, depth=None, flow=None)
    return shrunk(small, -(-max(views.size) // SMALL)) if len(views) >= FEWEST else small


def part(progress, first: float, last: float):
    """The callback `progress(fraction, text)` (or None) of a part of what it reports, from `first` to `last`."""
    return progress and (lambda fraction, text: progress(first + (last - first) * fraction, text))


def fit(
    values: dict[str, Tensor],
    rates: dict[str, tuple[float, float]],
    views: Views,
    seconds: float,
    *,
    beside: Views | None = None,
    most: int | None = None,
    price: float = 0.0,
    coarse: int | None = None,
    enough: int | None = None,
    steps: int | None = None,
    seed: int = 0,
    progress=None,
) -> tuple[float, Gaussians4D]:
    """Raw parameters fitted to views (and those `beside`) by `optimise` -> the best state's error on the views that
    judge, and that state. most: Gaussians are split up to this number; None: they stay as many as they are."""
    judges, cover = views[judging(views)], views.alpha.mean()
    p, generator = Parameters(values, rates), torch.Generator().manual_seed(seed)
    best, kept, looked, pull = math.inf, None, 0, torch.zeros_like(p["t"].detach())

    def loss(step: Step) -> Tensor:
        return photographs(step) + (price * cover * step.scene.opacity.mean() if price else 0.0)

    def look() -> None:
        nonlocal best, kept
        with torch.no_grad():
            now = activate(p.values)
            e = error(now, judges)
            if e < best or kept is None:
                best, kept = e, now.map(torch.clone)

    def edit(number: int, fraction: float) -> None:
        nonlocal looked, pull
        if most:
            pull += p["xyz"].grad.norm(dim=-1)
            if number % EVERY == 0 and fraction < UNTIL:
                densify(p, pull, generator, most)
                pull = torch.zeros_like(p["t"].detach())
        if fraction * LOOKS >= looked + 1:
            looked += 1
            look()

    optimise(
        p,
        lambda: activate(p.values),
        views,
        loss,
        seconds,
        beside=beside,
        steps=steps,
        enough=enough,
        coarse=coarse or max(views.size),
        edit=edit,
        seed=seed,
        text="refining",
        progress=progress,
    )
    look()
    return best, kept


def judging(views: Views, count: int = JUDGES) -> Tensor:
    """(at most `count`,) indices of the views that judge, spread over the clip."""
    order, n = views.time.argsort(stable=True), min(count, len(views))
    return order[[len(views) * (2 * i + 1) // (2 * n) for i in range(n)]]


@torch.no_grad()
def error(g: Gaussians4D, views: Views) -> float:
    """Mean squared error of the pictures over white, with the paper's inference filters."""
    height, width = views.size
    rgb, _ = render(g, views.c2w, views.intrinsics, views.time, width, height, inference=True)
    return float((rgb - views.over(1.0)).square().mean())


def raw(g: Gaussians4D, life: float = 1e-6, fade: float = 1.0) -> dict[str, Tensor]:
    """Gaussians -> raw parameters as `activate` takes them, σ_t at least `life`, opacity times `fade`."""
    return {
        "xyz": g.xyz,
        "t": g.t,
        "velocity": g.velocity,
        "sigma_t": g.sigma_t.clamp_min(life).log(),
        "scale": g.scale.clamp_min(1e-6).log(),
        "rotation": g.rotation,
        "rgb": g.rgb,
        "opacity": (fade * g.opacity).clamp(0.01, 0.99).logit(),
    }


@torch.no_grad()
def around(g: Gaussians4D, views: Views, seed: int = 0, count: int = AROUND) -> Views:
    """`count` pictures of the Gaussians from random sides at frames between the first and the last view, whether or not
    a view shows them, taken as the views are: from their median distance to the origin, with the median of their
    intrinsics."""
    rng = np.random.default_rng([seed, 11])
    distance = float(views.c2w[:, :3, 3].norm(dim=-1).median())
    steepest = math.sin(math.radians(STEEPEST))
    elevations = np.degrees(np.arcsin(rng.uniform(-steepest, steepest, count)))
    poses = [spherical(a, e, distance) for a, e in zip(rng.uniform(0, 360, count), elevations, strict=True)]
    c2w = torch.from_numpy(opengl_to_opencv(np.stack(poses))).to(views.c2w)
    intrinsics = views.intrinsics.median(0).values.expand(count, 4).clone()
    first, last = float(views.time.min()), float(views.time.max())
    frames = round((last - first) / views.frame_step) + 1
    time = first + views.frame_step * torch.from_numpy(rng.integers(frames, size=count)).to(views.time)
    height, width = views.size
    rgb, alpha = render(g, c2w, intrinsics, time, width, height, background=0.0, inference=True)
    rgb = rgb / alpha.clamp_min(1e-4)[..., None]  # straight
    return replace(views, rgb=rgb, alpha=alpha, c2w=c2w, intrinsics=intrinsics, time=time)
