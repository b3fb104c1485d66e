# SPDX-License-Identifier: GPL-3.0-or-later
"""The groups of clips that training draws from by weight: the sets of `timesplat curate`, or where that was not called,
what it would say of their motion alone."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ...datagen.curation.decisions import SETS as GROUPS
from ...datagen.curation.decisions import set_of
from ...datagen.sequence import InputError


def group_of(meta: Mapping[str, str]) -> str:
    """The group of a packed clip by its metadata; one of unknown motion (NaN) is of 4d."""
    return set_of(float(meta["motion"]), meta["displaced"] == "True" or meta["frames"] == "1")


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
