# SPDX-License-Identifier: GPL-3.0-or-later
"""Which Sequences show the same thing: their hashes are near, and so are their pictures at three moments. Objects that
are turned, and clips of one object that differ, are not the same. numpy only."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..sequence import read_sequence
from .measures import SEEN, by_camera, over_white, shrunk

NEAR = 12  # bits of 256 that may differ: noise turns a few over
ALIKE = 0.02  # mean difference of two pictures, 0..1, where either shows something: noise has less, a colour more
_BAND = 8  # hexadecimal digits, of which one band of two near hashes must be the same
_CROWD = 2000  # a band that so many share says nothing
_SIDE = 16  # pixels of the small pictures that are compared
_MOMENTS = (0.0, 1 / 3, 2 / 3)  # of the clip; loops end where they begin


def duplicates(hashes: dict[str, str], pictures: Callable[[str], np.ndarray | None]) -> dict[str, str]:
    """{name: the name, earlier in the order of `hashes`, that it is a duplicate of}, which is none itself. hashes: name
    -> hash (see `measures`); pictures: name -> what `small_pictures` makes of it, None where they cannot be read."""
    found: dict[str, str] = {}
    bands: dict[tuple[int, str], list[str]] = {}
    for name, text in hashes.items():
        rivals: dict[str, None] = {}
        for at in range(0, len(text), _BAND):
            band = text[at : at + _BAND]
            if not band.strip("0"):  # nothing is there
                continue
            same = bands.setdefault((at, band), [])
            if len(same) < _CROWD:
                rivals |= dict.fromkeys(same)
                same.append(name)
        near = [r for r in rivals if r not in found and distance(text, hashes[r]) <= NEAR]
        twin = next((r for r in near if _alike(pictures(name), pictures(r))), None)
        if twin is not None:
            found[name] = twin
    return found


def distance(a: str, b: str) -> float:
    """Bits in which two hashes differ, in parts of 256; infinite where they are of different cameras."""
    if len(a) != len(b) or not a:
        return float("inf")
    return 64 / len(a) * (int(a, 16) ^ int(b, 16)).bit_count()


def small_pictures(folder: Path) -> Callable[[str], np.ndarray | None]:
    """A function from the name of a Sequence below the folder to (V,16,16,4) float: RGB over white 0..1, and how much
    of it shows something, at three moments from every canonical camera."""

    @lru_cache(maxsize=256)
    def look(name: str) -> np.ndarray | None:
        try:
            cameras = by_camera(read_sequence(folder / name))
        except InputError:
            return None
        chosen = [c[round(m * (len(c) - 1))] for _, c in sorted(cameras.items()) for m in _MOMENTS]
        both = [np.concatenate([over_white(p), p[..., 3:] >= SEEN], -1) for p in chosen]
        return np.stack([shrunk(p, _SIDE, _SIDE) for p in both])

    return look


def _alike(a: np.ndarray | None, b: np.ndarray | None) -> bool:
    if a is None or b is None or a.shape != b.shape:
        return False
    shown = np.maximum(a[..., 3], b[..., 3])
    error = np.abs(a[..., :3] - b[..., :3]).mean(-1)
    return float(error.sum() / max(float(shown.sum()), 1e-6)) < ALIKE
