# SPDX-License-Identifier: GPL-3.0-or-later
"""Tracks fitted to views by gradient descent: their looks and offsets, while the paths stay as they are known.

Every view of the clip speaks of every track that it sees, so that nothing is learnt by heart from a moment's few. Now
and then the faint are removed, and those whose offsets the views pull at hardest are split in two on the same path.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from ..rotations import rotation_matrix
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
    every: int = 100  # steps between densifications …
    until: float = 0.6  # … and the share of the budget after which there are none
    share: float = 0.05  # of the tracks are split each time
    shrink: float = 1.6  # a split one's parts are smaller by this
    faint: float = 0.02  # opacity below which a track is removed


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
        opacity=torch.sigmoid(raw["opacity"]),
    )


def fit_tracks(
    start: Tracks4D,
    views: Views,
    schedule: Schedule,
    *,
    pixel: float,
    max_tracks: int,
    fit: TrackFit = FIT,
    progress=None,
) -> Tracks4D:
    """N tracks fitted to the views, split up to `max_tracks`. pixel: size at the object. For `progress` see
    `optimise`."""
    with gradients():
        views = detached(views)
        rates = {k: getattr(fit, k) for k in ("scale", "rotation", "rgb", "opacity")}
        rates["offset"] = tuple(pixel * r for r in fit.offset)
        p = Parameters({k: x.clone() for k, x in raw_tracks(start).items()}, rates)
        density = _Density(p, start, fit, max_tracks, torch.Generator().manual_seed(schedule.seed))
        optimise(
            p,
            lambda: activate_tracks(p.values, density.tracks),
            views,
            photometric_loss,
            schedule,
            after_backward=density.after_backward,
            text="fitting tracks",
            progress=progress,
        )
        done = activate_tracks({k: x.detach() for k, x in p.values.items()}, density.tracks)
        return done[done.opacity > fit.faint]


class _Density:
    """Which tracks there are: removes the faint, splits those that are pulled at."""

    def __init__(self, p: Parameters, tracks: Tracks4D, fit: TrackFit, max_tracks: int, generator: torch.Generator):
        self.p, self.tracks, self.fit, self.max_tracks, self.generator = p, tracks, fit, max_tracks, generator
        self.pull = torch.zeros(len(tracks))

    def after_backward(self, step: int, fraction: float) -> None:
        """To be called after the gradients of each step (counted from 1) are there, and before they are used."""
        self.pull += self.p["offset"].grad.norm(dim=-1)
        if step % self.fit.every == 0 and fraction < self.fit.until:
            self._densify()
            self.pull = torch.zeros(len(self.p["offset"]))

    @torch.no_grad()
    def _densify(self) -> None:
        p, fit = self.p, self.fit
        kept = (torch.sigmoid(p["opacity"]) > fit.faint).nonzero()[:, 0]
        n = len(kept)
        count = max(min(int(fit.share * n), self.max_tracks - n), 0)
        split = self.pull[kept].topk(count).indices
        rows = torch.cat([kept, kept[split]])
        p.keep_rows(rows)
        self.tracks = replace(self.tracks, path=self.tracks.path[rows])
        both = torch.cat([split, torch.arange(n, n + count)])
        scale, turn = p["scale"][split].exp(), rotation_matrix(F.normalize(p["rotation"][split], dim=-1))
        away = torch.randn(count, 3, generator=self.generator) * scale
        away = (turn @ away[..., None])[..., 0]
        p["offset"][both] += torch.cat([away, -away])
        p["scale"][both] -= torch.tensor(fit.shrink).log()
        p.reset_moments(both)
