# SPDX-License-Identifier: GPL-3.0-or-later
"""Test-time refinement: predicted 4D Gaussians fitted to the input views for some seconds, by gradient descent.

One view a moment says little about a scene, and is soon learnt by heart (33 dB on the inputs where other views
gain nothing any more). What keeps it from that:
    a prediction from RGB is merged into few, larger, longer-lived Gaussians first, which several views see each
    (and steps are several times faster); one from depth and motion is kept as it is, and left only a little;
    a price on opacity, random backgrounds, and small pictures at first;
    of the start and some states on the way, the best on a few input views is returned.
These are fitted like the others, so that they tell where a fit goes wrong, not where it begins to overfit. Held
out, they said "stay" of an object that gained 3.5 dB elsewhere, even after merging: the start is made of them.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ..datagen.sequence import InputError
from .baselines.four_dgs import EVERY, RATES, UNTIL, activate, densify
from .gaussians import Gaussians4D, Moving, scale_rotation_from_covariance
from .optimise import Parameters, Step, gradients, optimise, own, photographs
from .rasterize import render
from .views import Views

# A prediction from RGB. Means over four development objects of held-out PSNR after 10 CPU-seconds:
COUNT, MOST = 2000, 3000  # Gaussians after merging, and after splitting where the fit pulls: see `refine`
MOMENTS = 6  # parts of the clip within which Gaussians are merged
LIFE = 0.25  # least σ_t, an eighth of the clip: several views of one a frame
FADE = 0.3  # of opacity at the start: what hides the rest must not be there before it is known to be right
COARSE = 64  # longest side in pixels of the pictures at first: 0.1 dB and a fifth more steps
PRICE = 0.1  # of mean opacity, in the loss, times the share of the pictures that the object covers: 0.2 dB over 0.04
# Learning rates at the start and at the end, of the raw parameters, where depth and motion are known: places are
# right to a pixel, and some 80 steps are all there is time for. (Four times the rate of opacity, with the price, won a
# little more on clouds of 75,000, and lost on larger ones, which take fewer steps.) From RGB: those of four_dgs.
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
JUDGES = 4  # input views that judge
LOOKS = 6  # states on the way that are judged, the last one included


def check_seconds(seconds: float) -> None:
    """Raises InputError for what is no time to refine for."""
    if not (math.isfinite(seconds) and seconds >= 0):
        raise InputError(f"{seconds:g} seconds of refinement: give 0 or more.")


def refine(
    start: Gaussians4D | Moving,
    views: Views,
    seconds: float,
    device: str = "cpu",
    *,
    near: bool = False,
    steps: int | None = None,
    seed: int = 0,
    progress=None,
) -> Gaussians4D:
    """Gaussians and the input views that they are of -> refined Gaussians on the CPU, after `seconds` or exactly
    `steps`; `start` itself for zero seconds, or where the views that judge fit no better. `near`: the
    start knows depth and motion, so stay near it. For `progress` see `optimise`.

    Few Gaussians see more views each and make quick steps: over four objects, after 4 CPU-seconds, merging to
    2000 and splitting to 3000 gave 29.4 dB on held-out views; 3000 without splitting 29.2, 6000 split to 12000
    28.8, 4DGS from random points in the same seconds in all 29.0, the start 26.3.

    Raises InputError for a scene that is not of 4D Gaussians and for a wrong number of seconds."""
    check_seconds(seconds)
    if not isinstance(start, Gaussians4D):
        raise InputError("Refinement is of 4D Gaussians, and this method's scene is of another kind; leave it out.")
    if (seconds == 0 and not steps) or not len(start):
        return start
    with gradients():
        g = start.map(lambda x: x.detach().to(device).clone())
        g = g[g.alive()]
        if not len(g):
            return start
        views = own(views, device)
        judges = views[judging(views)]
        g = g if near else merge(g, COUNT, MOMENTS)
        best, kept = error(g, judges), None
        p = Parameters(raw(g) if near else raw(g, LIFE, FADE), NEAR if near else RATES)
        cover, looked = views.alpha.mean(), 0
        pull, generator = torch.zeros_like(p["t"].detach()), torch.Generator().manual_seed(seed)

        def loss(step: Step) -> Tensor:
            return photographs(step) + (0.0 if near else PRICE) * cover * step.scene.opacity.mean()

        def look() -> None:
            nonlocal best, kept
            with torch.no_grad():
                now = activate(p.values)
                e = error(now, judges)
                if e < best:
                    best, kept = e, now.map(torch.clone)

        def edit(number: int, fraction: float) -> None:
            nonlocal looked, pull
            if not near:
                pull += p["xyz"].grad.norm(dim=-1)
                if number % EVERY == 0 and fraction < UNTIL:
                    densify(p, pull, generator, MOST)
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
            steps=steps,
            coarse=max(views.size) if near else COARSE,
            edit=edit,
            seed=seed,
            text="refining",
            progress=progress,
        )
        look()
        return start if kept is None else kept.to("cpu")


def judging(views: Views) -> Tensor:
    """(at most JUDGES,) indices of the views that judge, spread over the clip."""
    order, n = views.time.argsort(stable=True), min(JUDGES, len(views))
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
def merge(g: Gaussians4D, count: int, moments: int) -> Gaussians4D:
    """About `count` Gaussians (or all, if they are no more) with the moments of those merged into them: those
    whose centres share a cell of a grid in space at the middle of one of `moments` parts of the clip."""
    if len(g) <= count:
        return g
    part = ((g.t.clamp(-1, 1) + 1) / 2 * moments).floor().clamp_max(moments - 1)
    place = g.position((part + 0.5) / moments * 2 - 1)
    small, large = 1e-3, 1.0
    for _ in range(16):  # bisection for the cell's side
        side = (small * large) ** 0.5
        cell = torch.cat([(place / side).floor(), part[:, None]], -1).long().clamp(-(2**14), 2**14 - 1) + 2**14
        key = ((cell[:, 0] * 2**15 + cell[:, 1]) * 2**15 + cell[:, 2]) * 2**15 + cell[:, 3] - 2**14
        _, owner = key.unique(return_inverse=True)
        n = int(owner.max()) + 1
        small, large = (side, large) if n > count else (small, side)
    weight = g.opacity * _area(g.scale) * g.sigma_t + 1e-12  # how much is seen of it, and how long
    total = weight.new_zeros(n).index_add(0, owner, weight)

    def mean(x: Tensor) -> Tensor:
        w = weight.view(-1, *[1] * (x.ndim - 1))
        return x.new_zeros(n, *x.shape[1:]).index_add(0, owner, x * w) / total.view(-1, *[1] * (x.ndim - 1))

    t, velocity = mean(g.t), mean(g.velocity)
    centre = g.position(t[owner])
    xyz = mean(centre)
    off = centre - xyz[owner]
    scale, rotation = scale_rotation_from_covariance(mean(g.covariance3() + off[:, :, None] * off[:, None]))
    sigma_t = mean(g.sigma_t.square() + (g.t - t[owner]).square()).sqrt()
    opacity = (total / (_area(scale) * sigma_t)).clamp(0.05, 0.9)
    return Gaussians4D(xyz, t, velocity, sigma_t, scale, rotation, mean(g.rgb), opacity)


def _area(scale: Tensor) -> Tensor:
    """(N,3) -> (N,) about what a Gaussian covers: the product of its two longer axes."""
    return scale.prod(-1) / scale.amin(-1)
