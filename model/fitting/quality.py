# SPDX-License-Identifier: GPL-3.0-or-later
"""How good a reconstruction shall be, by a name: what it is made of, never how long it may take, so that it comes out
the same on a machine that is slow or busy."""

from __future__ import annotations

from dataclasses import dataclass

from ...datagen.sequence import InputError


@dataclass(frozen=True)
class Quality:
    """What a fit is given; a method that gains nothing from so much of it takes less."""

    size: int  # longest side in pixels of the pictures; larger ones are averaged down first, by a whole factor
    steps: int
    gaussians: int  # at the most


QUALITIES = {
    "draft": Quality(128, 300, 10_000),
    "balanced": Quality(256, 1500, 30_000),
    "fine": Quality(512, 4000, 100_000),
    "best": Quality(1024, 15_000, 200_000),
}


def quality_named(name: str) -> Quality:
    """Raises InputError where there is none of this name."""
    if name not in QUALITIES:
        raise InputError(f"{name}: no such quality; choose one of {', '.join(QUALITIES)}.")
    return QUALITIES[name]
