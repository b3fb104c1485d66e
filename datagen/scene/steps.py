# SPDX-License-Identifier: GPL-3.0-or-later
"""Makes a borrowed scene's frames as long as the steps of a clip.

Blender's motion vectors lead to the frames right before and after. Where a clip takes each third frame, or some between
two, these are not its own, and three times a frame's motion is not that of three frames: things turn and speed up. With
Blender's time stretching the frames before and after are those of the clip.
"""

from __future__ import annotations

import math
from fractions import Fraction

from ..errors import InputError

_LARGEST = 900  # of the two numbers whose ratio Blender takes for the length of a frame
_OFF = 1e-4  # frames that the last of a hundred steps may be off


def lengthen_frames(stage, step: float) -> None:
    """One frame of the scene `stage` is `step` of what it was. InputError where no two of Blender's numbers say so."""
    render = stage.render
    length = Fraction(render.frame_map_old, render.frame_map_new) * Fraction(step).limit_denominator(_LARGEST)
    if (
        max(length.numerator, length.denominator) > _LARGEST
        or abs(Fraction(step).limit_denominator(_LARGEST) - Fraction(step)) * 100 > _OFF
    ):
        raise InputError(
            f"--every, --spread: motion vectors cannot lead over {step:g} frames in Blender; choose steps of at most "
            f"{_LARGEST}, or render with --no-passes."
        )
    render.frame_map_old, render.frame_map_new = length.numerator, length.denominator


def go_to(stage, frame: float, step: float = 1.0) -> None:
    """Shows the scene's frame `frame`, whole or not, where a frame was made `step` long."""
    at = frame / step
    whole = math.floor(at + 1e-9)
    stage.frame_set(whole, subframe=max(at - whole, 0.0))
