# SPDX-License-Identifier: GPL-3.0-or-later
"""What goes into a method, and what its pictures are compared with: views of a Sequence at a size."""

from __future__ import annotations

from collections.abc import Sequence as Indices
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from ..datagen.sequence import InputError, Sequence, read_sequence
from ..model.views import Views, load_views, shrink
from .flip import features


@dataclass
class Truth:
    """What predictions are compared with: V views at one size, and what metrics need of them, computed once."""

    views: Views
    picture: Tensor  # (V,H,W,3) over white
    novel: Tensor  # (V,) bool: no input shows it
    seen: dict[int, Tensor] = field(default_factory=dict)  # `flip.features` by view, made when asked for

    def features(self, i: int) -> Tensor:
        """(5,H,W) `flip.features` of the view i."""
        if i not in self.seen:
            self.seen[i] = features(self.picture[i])
        return self.seen[i]


def load_inputs(seq: Sequence, indices: Indices[int], has_depth: bool, size: int | None = None) -> Views:
    """Views at `size` pixels, a whole fraction of what was rendered (all of it by default), with depth and flow where
    `has_depth`. Raises InputError."""
    by = _fraction(seq, size)
    views = load_views(seq, indices, has_depth)
    if has_depth or by == 1:
        return shrink(views, by)
    still = views.alpha.new_zeros(()).expand(*views.alpha.shape, 4)
    return without_depth(shrink(replace(views, depth=torch.full_like(views.alpha, torch.inf), flow=still), by))


def load_truth(seq: Sequence, targets: Indices[int], novel: Indices[int], size: int | None = None) -> Truth:
    """The views `targets` at `size` pixels as truth; `novel` are those of them that no input shows."""
    views = load_views(seq, targets)
    picture, by = views.over(), _fraction(seq, size)
    if by > 1:  # over white first: then light is averaged, and nothing else is to be weighted
        picture = avg_pool2d(picture.movedim(-1, 1), by).movedim(1, -1).contiguous()
        alpha = avg_pool2d(views.alpha[:, None], by)[:, 0]
        views = replace(views, rgb=picture, alpha=alpha, intrinsics=views.intrinsics / by)
    chosen = set(novel)
    return Truth(views, picture, torch.tensor([i in chosen for i in targets]))


def _fraction(seq: Sequence, size: int | None) -> int:
    by = seq.width // (size or seq.width)
    if by < 1 or (size and (size * by != seq.width or seq.height % by)):
        raise InputError(f"{seq.root}: {seq.width}x{seq.height} pixels do not shrink to {size}; give a whole fraction.")
    return by


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
def kept_inputs(folder: Path, indices: tuple[int, ...], has_depth: bool, size: int) -> Views:
    """`load_inputs` of the Sequence in a folder; the last two are kept, for methods come one after another on them."""
    return load_inputs(read_sequence(folder), indices, has_depth, size)


@lru_cache(maxsize=4)
def kept_truth(folder: Path, targets: tuple[int, ...], novel: tuple[int, ...], size: int) -> Truth:
    """`load_truth` of the Sequence in a folder; the last four are kept."""
    return load_truth(read_sequence(folder), targets, novel, size)
