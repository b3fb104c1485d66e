# SPDX-License-Identifier: GPL-3.0-or-later
"""The groups of clips that training draws from by weight, as the paper's data has them (appendix, "Dataset Curation"):
`hq4d` moves much, but not wildly; `4d` is all else that moves; `3d` are still objects, displaced or not.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ...datagen.sequence import InputError

GROUPS = ("hq4d", "4d", "3d")


@dataclass(frozen=True)
class MotionBounds:
    """Between the groups, in units of `dataset.measure_motion`. (The paper keeps 3,000 of 32,000 objects, "sufficient
    but not overly aggressive"; of 135 of ours, animated files and zoo, these keep 59.)"""

    still: float = 0.01  # nothing moves below
    sufficient: float = 0.25  # hq4d from here …
    aggressive: float = 0.45  # … to below this


MOTION_BOUNDS = MotionBounds()


def group_of(meta: Mapping[str, str]) -> str:
    """The group of a packed clip by its metadata; one of unknown motion (NaN) is of 4d."""
    motion = float(meta["motion"])
    if meta["displaced"] == "True" or meta["frames"] == "1" or motion < MOTION_BOUNDS.still:
        return "3d"
    return "hq4d" if MOTION_BOUNDS.sufficient <= motion < MOTION_BOUNDS.aggressive else "4d"


def parse_mix(text: str) -> dict[str, float] | None:
    """ "200:50:1", as the paper draws -> weight of each group; "uniform" -> None: every clip is as likely. Raises
    InputError."""
    if text == "uniform":
        return None
    try:
        weights = dict(zip(GROUPS, map(float, text.split(":")), strict=True))
        if min(weights.values()) < 0 or not np.isfinite(sum(weights.values())):
            raise ValueError
    except ValueError:
        raise InputError(f"--mix {text}: not weights of {':'.join(GROUPS)}; write 200:50:1, or uniform.") from None
    return weights


def group_probabilities(mix: str, counts: Mapping[str, int]) -> np.ndarray:
    """(3,) how likely each of GROUPS is drawn. mix: see `parse_mix`; counts: clips in each, one without clips is left
    out. Raises InputError where no clip would ever be drawn."""
    weights = parse_mix(mix)
    weight = {g: counts[g] if weights is None else weights[g] * (counts[g] > 0) for g in GROUPS}
    if not sum(weight.values()):
        raise InputError(f"--mix {mix}: none of the clips is of a group with weight; there are {dict(counts)}.")
    return np.array([weight[g] for g in GROUPS]) / sum(weight.values())
