# SPDX-License-Identifier: GPL-3.0-or-later
"""Shows a tiny or a huge scene at a size that renders: Blender's cameras clip what is nearer than a millionth of a
unit, and beyond some hundred millions neither depth nor light is right."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import bpy

SMALLEST, LARGEST = 1e-4, 1e6  # half-sides, in scene units, that render as they are


@contextlib.contextmanager
def rescaled(factor: float) -> Iterator[None]:
    """The open scene `factor` times as large, about the world's origin: everything without a parent gets one. On
    leaving it is as it was. What constraints or physics place in the world does not follow."""
    scene = bpy.context.scene
    empty = bpy.data.objects.new("timesplat", None)
    empty.scale = (factor,) * 3
    scene.collection.objects.link(empty)
    roots = [ob for ob in scene.objects if ob.parent is None and ob != empty]
    for ob in roots:
        ob.parent = empty
        ob.matrix_parent_inverse.identity()
    try:
        yield
    finally:
        for ob in roots:
            ob.parent = None
        bpy.data.objects.remove(empty)
