# SPDX-License-Identifier: GPL-3.0-or-later
"""What goes into a method, and what its pictures are compared with: views of a Sequence at a size."""

from __future__ import annotations

from collections.abc import Sequence as Indices
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import torch
from torch import Tensor

from ..datagen.readers import DEFAULTS, ReadOptions, open_sequence
from ..datagen.sequence import Sequence
from ..model.views import Views, load_views, shrink_factor
from .flip import features


@dataclass
class Truth:
    """What predictions are compared with: V views at one size, and what metrics need of them, computed once."""

    views: Views
    picture: Tensor  # (V,H,W,3) over white
    novel: Tensor  # (V,) bool: no input shows it
    inside: Tensor | None = None  # (V,H,W) 0..1 where pictures are compared; elsewhere both are white
    seen: dict[int, Tensor] = field(default_factory=dict)  # `flip.features` by view, made when asked for

    def features(self, i: int) -> Tensor:
        """(5,H,W) `flip.features` of the view i."""
        if i not in self.seen:
            self.seen[i] = features(self.picture[i])
        return self.seen[i]


def load_truth(seq: Sequence, targets: Indices[int], novel: Indices[int], size: int | None = None) -> Truth:
    """The views `targets` at `size` pixels as truth; `novel` are those of them that no input shows. Light is averaged
    where they are made smaller, so that laid on white before or after is the same. Views without a mask, of a scene
    with masks, are compared where the hull of the others' masks is, and nowhere else."""
    views, chosen = load_views(seq, targets, size=size), set(novel)
    inside = None
    if seq.hull is not None:
        inside = torch.ones_like(views.alpha)
        for n, i in enumerate(targets):
            if (hull := seq.hull(i)) is not None:
                by = shrink_factor(seq, size)
                share = torch.from_numpy(hull.reshape(views.size[0], by, views.size[1], by)) / 255
                inside[n] = share.mean((1, 3))
        views = replace(views, alpha=views.alpha * inside)
    return Truth(views, views.over(), torch.tensor([i in chosen for i in targets]), inside)


def without_depth(views: Views) -> Views:
    """The views as photographs: RGB and alpha alone."""
    return replace(views, depth=None, flow=None, surface=None)


def collapsed(views: Views) -> Views:
    """One moment: all times 0, nothing moves."""
    flow = None if views.flow is None else torch.zeros_like(views.flow)
    return replace(views, time=torch.zeros_like(views.time), flow=flow, surface=None, frame_step=2.0)


def thinned(views: Views, step: int) -> Views:
    """Views of every `step`-th frame as those of a clip of `step` times fewer frames: motion vectors lead on at
    the same speed to what is the next frame then."""
    flow = None if views.flow is None else views.flow * step
    return replace(views, flow=flow, frame_step=views.frame_step * step)


# ---------------------------------------------------------------- kept from run to run of a process


@lru_cache(maxsize=2)
def kept_inputs(
    folder: Path, indices: tuple[int, ...], has_depth: bool, size: int, reading: ReadOptions = DEFAULTS
) -> Views:
    """`load_views` of the Sequence in a folder; the last two are kept, for methods come one after another on them."""
    return load_views(open_sequence(folder, reading), indices, has_depth, size)


@lru_cache(maxsize=4)
def kept_truth(
    folder: Path, targets: tuple[int, ...], novel: tuple[int, ...], size: int, reading: ReadOptions = DEFAULTS
) -> Truth:
    """`load_truth` of the Sequence in a folder; the last four are kept."""
    return load_truth(open_sequence(folder, reading), targets, novel, size)
