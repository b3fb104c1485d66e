# SPDX-License-Identifier: GPL-3.0-or-later
"""The pictures and splits of a Sequence as other programs want them."""

from __future__ import annotations

import math
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..image_files import write_png
from ..readers.lenses import Taps, sample
from ..sequence import HELD_OUT, Sequence, View

Progress = Callable[[float, str], None]
EACH = 8  # where nothing is held out, each so many-th view is listed for testing, and stays in training


def splits_of(seq: Sequence) -> dict[str, list[int]]:
    """The views of train, val and test, none of which is empty, for parsers open all three: where val or test lack,
    it is the other, and without both some of train."""
    held = {split: seq.select(rig=rig) for split, rig in HELD_OUT.items()}
    train = [i for i, v in enumerate(seq.views) if not v.held_out] or list(range(len(seq.views)))
    val, test = held["val"] or held["test"] or train[::EACH], held["test"] or held["val"] or train[::EACH]
    return {"train": train, "val": val, "test": test}


def put(seq: Sequence, index: int, path: Path) -> None:
    """Writes a view's picture as it is, RGBA."""
    if seq.picture is None:
        shutil.copyfile(seq.folder / seq.views[index].image, path)
    else:
        write_png(path, seq.load_image(index))


@dataclass(frozen=True)
class Square:
    """A camera that takes square pictures of `side` pixels, looks through their middle and has one focal length."""

    side: int
    focal: float

    @staticmethod
    def around(seq: Sequence) -> Square:
        """Such a camera that sees what every view sees, and as large as most do."""
        focal = float(np.median([f for v in seq.views for f in (v.fx, v.fy)]))
        reach = max(max(max(v.cx, seq.width - v.cx) / v.fx, max(v.cy, seq.height - v.cy) / v.fy) for v in seq.views)
        return Square(2 * math.ceil(focal * reach - 1e-6), focal)

    def is_of(self, view: View, seq: Sequence) -> bool:
        """Whether the view was taken by such a camera."""
        middle = (view.cx, view.cy) == (self.side / 2, self.side / 2)
        return middle and (seq.width, seq.height) == (self.side, self.side) and view.fx == view.fy == self.focal

    def put(self, seq: Sequence, index: int, path: Path) -> None:
        """Writes a view as this camera would have taken it; where it did not look, nothing is."""
        view = seq.views[index]
        if self.is_of(view, seq):
            return put(seq, index, path)
        at = (np.arange(self.side) + 0.5 - self.side / 2) / self.focal
        v, u = np.meshgrid(at * view.fy + view.cy, at * view.fx + view.cx, indexing="ij")
        out = sample(seq.load_image(index), Taps.at(u, v, seq.width, seq.height))
        out[(u < 0) | (v < 0) | (u > seq.width) | (v > seq.height)] = 0
        write_png(path, out)


def frame_names(seq: Sequence) -> dict[float, str]:
    """A word for each moment, of digits that sort as time does; with decimals where some are between frames."""
    frames = sorted({v.frame for v in seq.views})
    whole = all(isinstance(f, int) for f in frames)
    low = min(int(min(frames)), 0)  # negative ones would not sort
    return {f: f"{f - low:04d}" if whole else f"{f - low:08.3f}" for f in frames}


def camera_names(seq: Sequence) -> list[str]:
    """A name for each view's camera that can be part of a path, and that no two cameras of a frame share."""
    words = [re.sub(r"[^A-Za-z0-9-]+", "-", f"{v.camera}").strip("-") or "camera" for v in seq.views]
    taken: dict[tuple[float, str], int] = {}
    out = []
    for v, word in zip(seq.views, words, strict=True):
        n = taken[v.frame, word.lower()] = taken.get((v.frame, word.lower()), 0) + 1
        out.append(word if n == 1 else f"{word}-{n}")
    return out
