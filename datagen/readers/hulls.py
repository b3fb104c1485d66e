# SPDX-License-Identifier: GPL-3.0-or-later
"""Where in a picture without a mask the object can be: the hull of other pictures' masks of the same moment.

What is held out often has no mask, as in Panoptic, and what stands around the object is not reconstructed. The cells
of a grid that the masks of the moment's other cameras leave are halved, again and again, and drawn into the picture;
what is outside of them is background, of truth and of prediction alike.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ..sequence import Sequence, opengl_to_opencv
from .pictures import Pictures

CELLS = 20  # of the first grid, along each side of the object's box
HALVINGS = 3  # of cells that are left
AROUND = 0.05  # of the box's side is looked at beyond it
LEAST = 3  # masks of a moment that make a hull
STRAY = 10  # one in so many masks may be wrong


class MaskHulls:
    """Of a Sequence whose pictures are `Pictures`, some of them with masks."""

    def __init__(self, seq: Sequence, pictures: Pictures):
        self.seq, self.pictures = seq, pictures
        self._left = lru_cache(maxsize=2)(self._carved)  # views of a moment come one after another

    def __call__(self, index: int) -> np.ndarray | None:
        """(H,W) uint8 of a view: 255 where the object can be. None where it has a mask of its own, or where fewer than
        LEAST cameras have one at its moment."""
        view = self.seq.views[index]
        if self.pictures.sources[view.image].mask:
            return None
        left = self._left(view.frame)
        return None if left is None else self._drawn(index, *left)

    def __deepcopy__(self, memo: dict) -> MaskHulls:
        from copy import deepcopy

        return MaskHulls(deepcopy(self.seq, memo), deepcopy(self.pictures, memo))

    def _carved(self, frame: float) -> tuple[np.ndarray, float] | None:
        """The middles (P,3) of the cells that are left at a moment, and half their side."""
        seq = self.seq
        seen = [i for i in seq.select(frame=frame) if self.pictures.sources[seq.views[i].image].mask]
        if len(seen) < LEAST:
            return None
        masks = [self.pictures.alpha(seq.views[i], max(seq.width, seq.height)) > 0.5 for i in seen]
        low, high = np.array(seq.aabb, float)
        side = (high - low).max() * (1 + 2 * AROUND)
        at = (np.arange(CELLS) + 0.5) / CELLS - 0.5
        x, y, z = np.meshgrid(at, at, at, indexing="ij")
        points = (low + high) / 2 + side * np.stack([x, y, z], -1).reshape(-1, 3)
        half = side / CELLS / 2
        for halving in range(HALVINGS + 1):
            if halving:
                half /= 2
                corners = np.stack(np.meshgrid(*([-half, half],) * 3, indexing="ij"), -1).reshape(-1, 3)
                points = (points[:, None] + corners).reshape(-1, 3)
            outside, known = np.zeros(len(points), int), np.zeros(len(points), int)
            # While cells are halved, one is outside of a mask where none of it can be inside; at last, its middle.
            wide = 3**0.5 if halving < HALVINGS else 1.0
            for i, mask in zip(seen, masks, strict=True):
                px, py, depth, fx = self._projected(i, points)
                there, inside = _any_within(mask, px, py, wide * half * fx / np.maximum(depth, 1e-6))
                known += there & (depth > half)
                outside += (depth > half) & ~inside
            points = points[(outside <= len(seen) // STRAY) & (known >= len(seen) / 2)]
        return points, half

    def _projected(self, index: int, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        v = self.seq.views[index]
        c2w = opengl_to_opencv(v.c2w)
        local = (points - c2w[:3, 3]) @ c2w[:3, :3]
        depth = local[:, 2]
        with np.errstate(all="ignore"):
            return local[:, 0] / depth * v.fx + v.cx, local[:, 1] / depth * v.fy + v.cy, depth, max(v.fx, v.fy)

    def _drawn(self, index: int, points: np.ndarray, half: float) -> np.ndarray:
        """(H,W) uint8: the squares that cells cover in a view."""
        height, width = self.seq.height, self.seq.width
        px, py, depth, fx = self._projected(index, points)
        there = depth > half
        px, py, reach = px[there], py[there], half * fx / depth[there]
        # Corners of squares in a table of differences, whose sums say how many cells cover a pixel.
        x0, x1 = (np.clip(np.floor(px + s * reach) + (s > 0), 0, width).astype(int) for s in (-1, 1))
        y0, y1 = (np.clip(np.floor(py + s * reach) + (s > 0), 0, height).astype(int) for s in (-1, 1))
        count = np.zeros((height + 1, width + 1), int)
        for y, x, sign in ((y0, x0, 1), (y0, x1, -1), (y1, x0, -1), (y1, x1, 1)):
            np.add.at(count, (y, x), sign)
        return (count.cumsum(0).cumsum(1)[:-1, :-1] > 0) * np.uint8(255)


def _any_within(mask: np.ndarray, x: np.ndarray, y: np.ndarray, reach: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(P,) bool: whether squares of `reach` (P,) around places x, y (P,) in pixels touch a mask's picture (H,W), and
    whether any pixel in them is inside the mask; what lies beyond the picture's border counts as inside."""
    height, width = mask.shape
    total = np.zeros((height + 1, width + 1), int)
    total[1:, 1:] = mask.cumsum(0).cumsum(1)
    x, y = np.nan_to_num(x, nan=-1e6, posinf=-1e6, neginf=-1e6), np.nan_to_num(y, nan=-1e6, posinf=-1e6, neginf=-1e6)
    x0, x1 = np.floor(x - reach), np.floor(x + reach) + 1
    y0, y1 = np.floor(y - reach), np.floor(y + reach) + 1
    beyond = (x0 < 0) | (y0 < 0) | (x1 > width) | (y1 > height)
    x0, x1 = (np.clip(v, 0, width).astype(int) for v in (x0, x1))
    y0, y1 = (np.clip(v, 0, height).astype(int) for v in (y0, y1))
    inside = total[y1, x1] - total[y0, x1] - total[y1, x0] + total[y0, x0] > 0
    return (x0 < x1) & (y0 < y1), beyond | inside
