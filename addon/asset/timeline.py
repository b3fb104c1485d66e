# SPDX-License-Identifier: GPL-3.0-or-later
"""An object over the timeline: whether it may change, and the scene at one frame after another."""

from __future__ import annotations

from collections.abc import Iterable, Iterator


def may_change(ob) -> bool:
    """Whether the object's place or its sliders might change with the frame: quick, and True in doubt."""
    above = ob
    while above:
        bound = above.constraints or above.rigid_body or (above.parent and above.parent_type != "OBJECT")
        if above.animation_data or bound:
            return True
        above = above.parent
    return False


def visit_frames(frames: Iterable[int], context) -> Iterator[int]:
    """Takes the scene to each of the frames, and back in the end."""
    scene = context.scene
    now = scene.frame_current, scene.frame_subframe
    try:
        for frame in frames:
            scene.frame_set(frame)
            yield frame
    finally:
        scene.frame_set(now[0], subframe=now[1])
