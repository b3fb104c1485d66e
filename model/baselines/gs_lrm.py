# SPDX-License-Identifier: GPL-3.0-or-later
"""GS-LRM (Zhang et al. 2024) on moving things, the two ways in which the paper compares with it (section 4):
frame by frame, and with all views taken for views of one moment.

The network is ours, trained on single moments (`timesplat train --static`): all its times are 0.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ...datagen.sequence import InputError
from ..gaussians import Gaussians4D
from ..io.asset import Clip
from ..views import Views


@dataclass
class Slices:
    """One unmoving cloud per moment; at any time the cloud of the nearest moment is shown (of two equally near
    the earlier one). A `DynamicScene`: render it with `rasterize.render`."""

    gaussians: Gaussians4D  # (N,) all moments' clouds, frozen
    owner: Tensor  # (N,) index into `moments`
    moments: Tensor  # (M,) model times, ascending

    def at(self, t: float) -> Gaussians4D:
        return self.gaussians[self.owner == (self.moments - t).abs().argmin()]

    def __len__(self) -> int:
        return len(self.gaussians)

    def __getitem__(self, index) -> Slices:
        """Index or mask over the N Gaussians; the moments stay."""
        return Slices(self.gaussians[index], self.owner[index], self.moments)

    def alive(self) -> Tensor:
        """See `Gaussians4D.alive`."""
        return self.gaussians.alive()

    def to(self, *args, **kwargs) -> Slices:
        moved = self.gaussians.to(*args, **kwargs)
        return Slices(moved, self.owner.to(moved.xyz.device), self.moments.to(moved.xyz.device))

    def to_asset(self, clip: Clip):
        """Raises InputError: a cloud that jumps from moment to moment is no 4D Gaussian asset."""
        raise InputError("gs-lrm-frame: a cloud per frame is no 4D Gaussian asset; evaluate it, or choose gs-lrm-all.")


def collapse(views: Views) -> Views:
    """The views with their times set to 0."""
    return replace(views, time=torch.zeros_like(views.time))


def all_in(views: Views, run: Callable[[Views], Gaussians4D]) -> Gaussians4D:
    """One unmoving cloud from all views at once; `run` is the network from Views to Gaussians."""
    return run(collapse(views)).frozen(0.0)


def per_frame(views: Views, run: Callable[[Views], Gaussians4D]) -> Slices:
    """For every distinct time a cloud from the views of that time alone. A time at which no view shows the
    object has none (the nearest one that has stands in), and so have times between. Where no view of any time
    shows it: no Gaussian at all."""
    shown = views.alpha.flatten(1).amax(1) > 0.5
    moments = views.time[shown].unique()
    clouds = [run(collapse(views[shown & (views.time == t)])).frozen(0.0) for t in moments]
    if not clouds:
        from .visual_hull import white

        return Slices(white(views), torch.zeros(0, dtype=torch.long), torch.zeros(1))
    owner = torch.arange(len(clouds)).repeat_interleave(torch.tensor([len(c) for c in clouds]))
    return Slices(Gaussians4D.cat(clouds), owner, moments)
