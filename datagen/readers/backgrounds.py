# SPDX-License-Identifier: GPL-3.0-or-later
"""A constant colour behind the object: named or measured at the pictures' rims, and made transparent. numpy alone."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ..sequence import InputError

COLOURS = {"white": (255.0, 255.0, 255.0), "black": (0.0, 0.0, 0.0), "green": (0.0, 255.0, 0.0)}
FLAT_NOISE = 8.0  # levels of 255 that a named background colour may be off
BORDER = 2  # pixels of the rim that is taken for background
PLAIN = 0.6  # the least share of a rim that has the background's colour
MOST = 0.8  # the least share of the pictures that agree
NEAR = 12  # levels of 255 within which colours are the same when a rim is measured
SOFT = 20  # levels from what is background to what is opaque, for the mixed pixels of an edge


@dataclass(frozen=True)
class Background:
    """A constant colour behind the object: sRGB 0..255, and how far from it (the largest of three differences) a
    picture still is when it shows nothing else."""

    colour: tuple[float, float, float]
    noise: float

    def __str__(self) -> str:
        return "#" + "".join(f"{round(c):02x}" for c in self.colour)


def colour_of(text: str) -> Background:
    """A background that the user named. Raises InputError."""
    if text in COLOURS:
        return Background(COLOURS[text], FLAT_NOISE)
    digits = text.removeprefix("#")
    if len(digits) == 6 and all(c in "0123456789abcdefABCDEF" for c in digits):
        r, g, b = (float(int(digits[k : k + 2], 16)) for k in (0, 2, 4))
        return Background((r, g, b), FLAT_NOISE)
    raise InputError(f"--background {text}: choose white, black, green, #rrggbb or auto.")


def common_colour(pictures: Iterable[np.ndarray]) -> Background | None:
    """pictures (H,W,3) uint8 -> the colour that their rims have in common; None where they have none."""
    count, found = 0, []
    for picture in pictures:
        rgb = picture.astype(np.float32)
        sides = (rgb[:BORDER], rgb[-BORDER:], rgb[:, :BORDER], rgb[:, -BORDER:])
        rim = np.concatenate([x.reshape(-1, 3) for x in sides])
        colour = np.median(rim, 0)
        off = np.abs(rim - colour).max(1)
        count += 1
        if (off <= NEAR).mean() >= PLAIN:
            found.append((colour, float(np.percentile(off[off <= NEAR], 99))))
    if len(found) < max(MOST * count, 1):
        return None
    colour = np.median([c for c, _ in found], 0)
    if np.mean([np.abs(c - colour).max() <= NEAR for c, _ in found]) < MOST:
        return None
    return Background((float(colour[0]), float(colour[1]), float(colour[2])), max(n for _, n in found))


def key_out(rgba: np.ndarray, background: Background) -> np.ndarray:
    """(H,W,4) uint8 with alpha 0 where the background's colour is reached from the rim, and mixed edges soft, so that
    over the background the same picture comes out. What has its colour inside the object stays opaque."""
    behind = np.array(background.colour, np.float32)
    rgb = rgba[..., :3].astype(np.float32)
    off = np.abs(rgb - behind).max(-1)
    least = background.noise + 3
    alpha = np.clip((off - least) / SOFT, 0, 1)
    rim = np.ones(off.shape, bool)
    rim[1:-1, 1:-1] = False
    empty = flood(off <= least, rim)
    near = empty.copy()
    for _ in range(2):  # an edge is at most two pixels wide
        near[1:] |= near[:-1].copy()
        near[:-1] |= near[1:].copy()
        near[:, 1:] |= near[:, :-1].copy()
        near[:, :-1] |= near[:, 1:].copy()
    alpha = np.where(near, np.where(empty, 0, alpha), 1)
    own = (rgb - (1 - alpha[..., None]) * behind) / np.maximum(alpha[..., None], 1e-3)
    return np.concatenate([np.clip(np.rint(own), 0, 255), np.rint(255 * alpha[..., None])], -1).astype(np.uint8)


def flood(open_: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """(H,W) bool: what of `open_` is connected with one of its `seeds`, over its four sides."""
    reached = open_ & seeds
    runs = []  # the number of each pixel's run in its row, and in its column
    for axis in (1, 0):
        walls = np.cumsum(~open_, axis)
        along = np.arange(open_.shape[1 - axis]) * (open_.shape[axis] + 1)
        runs.append(walls + (along[:, None] if axis == 1 else along[None]))
    while True:
        before = int(reached.sum())
        for run in runs:
            hit = np.zeros(int(run.max()) + 1, bool)
            hit[run[reached]] = True
            reached = open_ & hit[run]
        if int(reached.sum()) == before:
            return reached
