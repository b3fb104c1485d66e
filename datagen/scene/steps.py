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


def lengthen_frames(stage, step: float) -> float:
    """One frame of the scene `stage` becomes `step` of what it was, or the nearest to it that two of Blender's numbers
    say, within a two-thousandth: that is returned. InputError where they cannot."""
    render = stage.render
    before = Fraction(render.frame_map_old, render.frame_map_new)
    wanted = before * Fraction(step)
    if not Fraction(1, _LARGEST) <= wanted <= _LARGEST:
        raise InputError(
            f"--every, --spread: motion vectors cannot lead over {step:g} frames in Blender; choose steps of at most "
            f"{_LARGEST}, or render with --no-passes."
        )
    if wanted >= 1:
        length = wanted.limit_denominator(int(_LARGEST / wanted))
    else:
        length = 1 / (1 / wanted).limit_denominator(int(_LARGEST * wanted))
    render.frame_map_old, render.frame_map_new = length.numerator, length.denominator
    return float(length / before)


def go_to(stage, frame: float, step: float = 1.0) -> None:
    """Shows the scene's frame `frame`, whole or not, where `lengthen_frames` returned `step`."""
    at = frame / step
    whole = math.floor(at + 1e-9)
    stage.frame_set(whole, subframe=max(at - whole, 0.0))
