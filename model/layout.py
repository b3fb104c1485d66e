# SPDX-License-Identifier: GPL-3.0-or-later
"""Layouts: names for the channels of a tensor, so that nothing slices them by number."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import accumulate

import torch
from torch import Tensor


@dataclass(frozen=True)
class Layout:
    """What the last dimension of a tensor holds, in order. A channel group that is one wide is read and given
    without that dimension."""

    widths: dict[str, int]

    @property
    def width(self) -> int:
        """Of all groups together."""
        return sum(self.widths.values())

    def __contains__(self, name: str) -> bool:
        return name in self.widths

    def without(self, name: str) -> Layout:
        """The same layout, but for one group."""
        return Layout({k: n for k, n in self.widths.items() if k != name})

    def slice(self, first: str, last: str | None = None) -> slice:
        """Where the group `first` is, or all from it to the group `last`."""
        ends = dict(zip(self.widths, accumulate(self.widths.values()), strict=True))
        return slice(ends[first] - self.widths[first], ends[last or first])

    def split(self, x: Tensor) -> dict[str, Tensor]:
        """x (…,width) -> each group by its name, (…,n), or (…) where n is 1; views of x."""
        groups = x.split(list(self.widths.values()), -1)
        return {k: g if n > 1 else g[..., 0] for (k, n), g in zip(self.widths.items(), groups, strict=True)}

    def join(self, **groups: Tensor) -> Tensor:
        """Every group by its name, (…,n), or (…) where n is 1 -> (…,width). Raises ValueError where one is missing,
        unknown, or not of its width."""
        if groups.keys() != self.widths.keys():
            raise ValueError(f"these are not the channels of the layout: {sorted(groups.keys() ^ self.widths.keys())}")
        parts = [groups[k] if n > 1 else groups[k][..., None] for k, n in self.widths.items()]
        for (name, n), part in zip(self.widths.items(), parts, strict=True):
            if part.shape[-1] != n:
                raise ValueError(f"{name} has {part.shape[-1]} channels, its layout {n}")
        return torch.cat(parts, -1)
