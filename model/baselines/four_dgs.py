# SPDX-License-Identifier: GPL-3.0-or-later
"""4DGS (Yang et al. 2024): 4D Gaussians fitted to one scene's photographs, starting from random points.

As there: random positions in the box and random times, a decaying position rate, densification by accumulated
positional gradients, pruning of the faint, all four dimensions split alike. Otherwise than there, for seconds
on a CPU instead of half an hour on a GPU: the kinematic form of the same Gaussians (`gaussians.py`), plain
colour, rates about ten times higher, random backgrounds with a loss on alpha, and a weight on opacity, without
which the views, one a moment, are soon learnt by heart: it was worth about 0.3 dB on held-out views.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..fitting.densify import Densifier
from ..fitting.fit_views import detached
from ..fitting.loop import Schedule, Step, gradients, optimise, photometric_loss
from ..fitting.parameters import RATES, Parameters, activate
from ..gaussians import Gaussians4D
from ..views import Views

POINTS = 8000  # at the start; most lie outside of the object and fade
MAX_GAUSSIANS = 12000  # densification stops there, where no other number is asked for
SIGMA_T, SCALE, OPACITY = 0.25, 0.04, 0.1  # of a Gaussian at the start; σ_t an eighth of the clip
OPACITY_WEIGHT = 0.04  # of mean opacity, in the loss, times the share of the pictures that the object covers


def four_dgs(
    views: Views,
    device: str = "cpu",
    seconds: float = 10.0,
    steps: int | None = None,
    seed: int = 0,
    max_gaussians: int = MAX_GAUSSIANS,
    progress=None,
) -> Gaussians4D:
    """Views (RGB and alpha alone are used) -> Gaussians4D (N,) on the CPU, after `seconds`, or `steps` where given, and
    no more than `max_gaussians`. For `progress` see `optimise`."""
    with gradients():
        views = detached(views, device)
        generator = torch.Generator().manual_seed(seed)
        p = Parameters(random_points(views, generator, min(POINTS, max_gaussians)), RATES)
        densifier = Densifier(p, generator, max_gaussians)
        weight = OPACITY_WEIGHT * views.alpha.mean()

        def loss(step: Step) -> Tensor:
            return photometric_loss(step) + weight * step.scene.opacity.mean()

        optimise(
            p,
            lambda: activate(p.values),
            views,
            loss,
            Schedule(seconds=seconds, steps=steps, seed=seed),
            after_backward=densifier.after_backward,
            text="4dgs",
            progress=progress,
        )
        return activate(p.values).map(Tensor.detach).to("cpu")


def random_points(views: Views, generator: torch.Generator, n: int = POINTS) -> dict[str, Tensor]:
    """Raw parameters of `n` Gaussians anywhere in the box, at any time, in the object's mean colour."""
    weight = views.alpha[..., None]
    raw = {
        "xyz": 2 * torch.rand(n, 3, generator=generator) - 1,
        "t": 2 * torch.rand(n, generator=generator) - 1,
        "velocity": torch.zeros(n, 3),
        "sigma_t": torch.full((n,), SIGMA_T).log(),
        "scale": torch.full((n, 3), SCALE).log(),
        "rotation": torch.randn(n, 4, generator=generator),
        "rgb": ((views.rgb * weight).sum((0, 1, 2)) / weight.sum().clamp_min(1e-6)).expand(n, 3),
        "opacity": torch.full((n,), OPACITY).logit(),
    }
    return {k: x.to(views.rgb) for k, x in raw.items()}
