# SPDX-License-Identifier: GPL-3.0-or-later
"""Tracks fitted to views by gradient descent: their looks and offsets, while the paths stay as they are known.

Every view of the clip speaks of every track that it sees, so that nothing is learnt by heart from a moment's few. What
fades away leaves. Nothing is split: the points lie as densely as the pixels, and to split those that are pulled at
hardest lost 0.2 to 0.4 dB of held-out views, at 24 views and at 144.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch.nn.functional as F
from torch import Tensor

from ..tracks import Tracks4D
from ..views import Views
from .fit_views import detached
from .loop import Schedule, gradients, optimise, photometric_loss
from .parameters import Parameters


@dataclass(frozen=True)
class TrackFit:
    """How tracks are fitted; rates of Adam at the start and at the end, those of offsets in pixels."""

    offset: tuple[float, float] = (0.1, 0.01)
    scale: tuple[float, float] = (4e-2, 4e-3)
    rotation: tuple[float, float] = (1e-2, 1e-3)
    rgb: tuple[float, float] = (2e-2, 2e-3)
    opacity: tuple[float, float] = (1e-1, 1e-2)
    steps_a_view: int = 25  # beyond which views are learnt by heart …
    least_steps: int = 600  # … or so many
    seldom: float = 1.0  # by which what is hidden from the views stays as it began, see `Parameters`
    faint: float = 0.02  # opacity below which a track leaves


FIT = TrackFit()


def raw_tracks(tracks: Tracks4D) -> dict[str, Tensor]:
    """The raw parameters of which `activate_tracks` makes the looks."""
    return {
        "offset": tracks.offset,
        "scale": tracks.scale.clamp_min(1e-6).log(),
        "rotation": tracks.rotation,
        "rgb": tracks.rgb,
        "opacity": tracks.opacity.clamp(0.01, 0.99).logit(),
    }


def activate_tracks(raw: dict[str, Tensor], like: Tracks4D) -> Tracks4D:
    """Raw looks (N,…) -> tracks on the paths of `like`."""
    return replace(
        like,
        offset=raw["offset"],
        scale=raw["scale"].exp(),
        rotation=F.normalize(raw["rotation"], dim=-1),
        rgb=raw["rgb"],
        opacity=raw["opacity"].sigmoid(),
    )


def fit_tracks(
    start: Tracks4D,
    views: Views,
    schedule: Schedule,
    *,
    pixel: float,
    fit: TrackFit = FIT,
    progress=None,
) -> Tracks4D:
    """N tracks fitted to the views on the CPU, without those that fade away. pixel: size at the object. For `progress`
    see `optimise`."""
    with gradients():
        views = detached(views)
        rates = {k: getattr(fit, k) for k in ("scale", "rotation", "rgb", "opacity")}
        rates["offset"] = tuple(pixel * r for r in fit.offset)
        p = Parameters({k: x.clone() for k, x in raw_tracks(start).items()}, rates, seldom=fit.seldom)
        optimise(
            p,
            lambda: activate_tracks(p.values, start),
            views,
            photometric_loss,
            schedule,
            text="fitting tracks",
            progress=progress,
        )
        done = activate_tracks({k: x.detach() for k, x in p.values.items()}, start)
        return done[done.opacity > fit.faint]
