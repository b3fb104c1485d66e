# SPDX-License-Identifier: GPL-3.0-or-later
"""4DGS (Yang et al. 2024): 4D Gaussians fitted to one scene's photographs, starting from random points.

As there: random positions in the box and random times, a decaying position rate, densification by accumulated
positional gradients, pruning of the faint, all four dimensions split alike. Otherwise than there, for seconds
on a CPU instead of half an hour on a GPU: the kinematic form of the same Gaussians (`gaussians.py`), plain
colour, rates about ten times higher, random backgrounds with a loss on alpha, and a price on opacity, without
which the views, one a moment, are soon learnt by heart: it was worth about 0.3 dB on held-out views.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from ..fitting.loop import Parameters, Step, gradients, optimise, own, photographs
from ..gaussians import Gaussians4D
from ..rotations import rotation_matrix
from ..views import Views

POINTS = 8000  # at the start; most lie outside of the object and fade
MOST = 12000  # densification stops there
LIFE, SCALE, OPACITY = 0.25, 0.04, 0.1  # of a Gaussian at the start; σ_t an eighth of the clip
# Learning rates at the start and at the end, of the raw parameters.
RATES = {
    "xyz": (4e-3, 4e-4),
    "t": (2e-3, 2e-4),
    "velocity": (1e-2, 1e-3),
    "sigma_t": (1e-2, 1e-3),
    "scale": (2e-2, 5e-3),
    "rotation": (1e-2, 2e-3),
    "rgb": (2e-2, 4e-3),
    "opacity": (1e-1, 2e-2),
}
PRICE = 0.04  # of mean opacity, in the loss, times the share of the pictures that the object covers
EVERY, UNTIL = 40, 0.6  # steps between densifications, and the share of the budget after which there are none
SHARE = 0.05  # of the Gaussians are split each time
SHRINK = 1.6  # a split Gaussian's parts are smaller by this
FAINT = 0.02  # opacity below which a Gaussian is removed
OUTSIDE = 1.2  # or when its centre left the box this far


def four_dgs(
    views: Views, device: str = "cpu", seconds: float = 10.0, steps: int | None = None, seed: int = 0, progress=None
) -> Gaussians4D:
    """Views (RGB and alpha alone are used) -> Gaussians4D on the CPU, after `seconds`, or `steps` where given.
    For `progress` see `optimise`."""
    with gradients():
        views = own(views, device)
        generator = torch.Generator().manual_seed(seed)
        p = Parameters(random_points(views, generator), RATES)
        cover = views.alpha.mean()
        pull = torch.zeros(POINTS, device=device)  # how hard each was pulled since the last densification

        def loss(step: Step) -> Tensor:
            return photographs(step) + PRICE * cover * step.scene.opacity.mean()

        def edit(number: int, fraction: float) -> None:
            nonlocal pull
            pull += p["xyz"].grad.norm(dim=-1)
            if number % EVERY == 0 and fraction < UNTIL:
                densify(p, pull, generator)
                pull = torch.zeros_like(p["t"].detach())

        optimise(
            p,
            lambda: activate(p.values),
            views,
            loss,
            seconds,
            steps=steps,
            edit=edit,
            seed=seed,
            text="4dgs",
            progress=progress,
        )
        return activate(p.values).map(Tensor.detach).to("cpu")


def random_points(views: Views, generator: torch.Generator) -> dict[str, Tensor]:
    """Raw parameters of POINTS Gaussians anywhere in the box, at any time, in the object's mean colour."""
    n, weight = POINTS, views.alpha[..., None]
    raw = {
        "xyz": 2 * torch.rand(n, 3, generator=generator) - 1,
        "t": 2 * torch.rand(n, generator=generator) - 1,
        "velocity": torch.zeros(n, 3),
        "sigma_t": torch.full((n,), LIFE).log(),
        "scale": torch.full((n, 3), SCALE).log(),
        "rotation": torch.randn(n, 4, generator=generator),
        "rgb": ((views.rgb * weight).sum((0, 1, 2)) / weight.sum().clamp_min(1e-6)).expand(n, 3),
        "opacity": torch.full((n,), OPACITY).logit(),
    }
    return {k: x.to(views.rgb) for k, x in raw.items()}


def activate(raw: dict[str, Tensor]) -> Gaussians4D:
    """Raw parameters -> Gaussians."""
    return Gaussians4D(
        xyz=raw["xyz"],
        t=raw["t"],
        velocity=raw["velocity"],
        sigma_t=raw["sigma_t"].exp(),
        scale=raw["scale"].exp(),
        rotation=F.normalize(raw["rotation"], dim=-1),
        rgb=raw["rgb"],
        opacity=torch.sigmoid(raw["opacity"]),
    )


@torch.no_grad()
def densify(p: Parameters, pull: Tensor, generator: torch.Generator, most: int = MOST) -> None:
    """Removes the faint and the lost, and splits the SHARE of the rest that was pulled hardest (pull (N,)) in
    two: smaller, and apart by a random step within the Gaussian, so that both together look about as it did;
    never more than `most` in all."""
    keep = (torch.sigmoid(p["opacity"]) > FAINT) & (p["xyz"].abs().amax(-1) < OUTSIDE)
    kept = keep.nonzero()[:, 0]
    n = len(kept)
    count = max(min(int(SHARE * n), most - n), 0)
    split = pull[kept].topk(count).indices
    p.rows(torch.cat([kept, kept[split]]))
    both = torch.cat([split, torch.arange(n, n + count, device=split.device)])
    g = activate(p.values)[split]
    step = torch.randn(count, 3, generator=generator).to(g.scale) * g.scale
    step = (rotation_matrix(g.rotation) @ step[..., None])[..., 0]
    p["xyz"][both] += torch.cat([step, -step])
    p["scale"][both] -= torch.tensor(SHRINK).log()
    p.forget(both)
