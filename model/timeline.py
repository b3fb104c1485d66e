# SPDX-License-Identifier: GPL-3.0-or-later
"""An index of lifetimes, so that a frame touches only the Gaussians that live then.

MEGA (Zhang et al. 2024) counted about six in a hundred of a 4DGS model alive at a time. The clip is cut into bins,
and each lists, once, the Gaussians that the paper's inference filters let through at some time within it.
"""

from __future__ import annotations

import torch

from .gaussians import Gaussians4D
from .rasterize import FILTER

BINS = 64  # of the clip


class Timeline:
    """A moving scene (`Moving`) of 4D Gaussians (N,) that draws as they do with the inference filters on."""

    def __init__(self, g: Gaussians4D, bins: int = BINS):
        self.gaussians = g
        # Alive while marginal and weighted opacity reach FILTER: |t - μ_t| <= σ_t sqrt(2 ln(min(1, o) / FILTER))
        reach = g.sigma_t * (2 * (g.opacity.clamp_max(1.0) / FILTER).clamp_min(1.0).log()).sqrt()
        first, last = ((x + 1) / 2 * bins for x in (g.t - reach, g.t + reach))
        drawn = g.opacity >= FILTER
        self.bins = [(drawn & (first <= k + 1) & (last >= k)).nonzero()[:, 0] for k in range(bins)]

    def __len__(self) -> int:
        return len(self.gaussians)

    def alive(self, t: float) -> torch.Tensor:
        """Indices, ascending, of a set that holds all that live at time t; times beyond the clip are its ends'."""
        k = int((min(max(t, -1.0), 1.0) + 1) / 2 * len(self.bins))
        return self.bins[min(k, len(self.bins) - 1)]

    def at(self, t: float) -> Gaussians4D:
        """Those that live about time t, as they are then, for ever (`Moving`)."""
        return self.gaussians[self.alive(t)].frozen(t)
