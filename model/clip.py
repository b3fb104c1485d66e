# SPDX-License-Identifier: GPL-3.0-or-later
"""The Clip of a Sequence: what leads an asset made of it back to its scene."""

from __future__ import annotations

from ..datagen.sequence import Sequence
from .io.asset import Clip


def clip_of(seq: Sequence) -> Clip:
    """At the scene's frames where these are noted and lie evenly (a last one that repeats is a scene that holds still),
    else at the Sequence's own. Its rate is that of these frames."""
    first, count = seq.frame_start, seq.frame_end - seq.frame_start + 1
    step, frames = 1, seq.provenance.get("scene_frames")
    if isinstance(frames, list) and len(frames) == count and all(type(f) is int for f in frames):
        apart = frames[1] - frames[0] if count > 1 else 1
        if apart > 0 and frames == [min(frames[0] + i * apart, frames[-1]) for i in range(count)]:
            first, step = frames[0], apart
    n = seq.normalisation
    return Clip(seq.fps * step, first, first + step * (count - 1), n.scale, tuple(n.translation), seq.pixel_size)
