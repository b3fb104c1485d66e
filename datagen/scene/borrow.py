# SPDX-License-Identifier: GPL-3.0-or-later
"""Lends out the open scene: a throw-away copy that may be changed and stepped through, while the scene itself stays as
it is."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import bpy

_TYPES_LEFT_OUT = ("CAMERA", "GPENCIL", "GREASEPENCIL")


def shown_objects(scene, view_layer) -> list:
    """The objects of the scene that a render of the view layer could show: those in a collection that is
    neither excluded nor hidden from renders. (An object's own hide_render may be animated; it is kept.)"""
    shown = set()

    def walk(layer, hidden):
        hidden = hidden or layer.exclude or layer.collection.hide_render
        if not hidden:
            shown.update(layer.collection.objects)
        for child in layer.children:
            walk(child, hidden)

    walk(view_layer.layer_collection, False)
    return [ob for ob in scene.objects if ob in shown]


@contextlib.contextmanager
def borrowed(objects: list | None = None, *, lights: bool = True) -> Iterator:
    """A throw-away copy of the open scene with one view layer, to change and to step through at will.

    objects: what it contains; None = all that renders show; lights False leaves light objects out. Cameras are left
    out, and so are Grease Pencil, which has no depth, and shadow catchers, which are no things. Without a window
    the copy stands in for the scene wherever this is referred to: a driver that reads the scene's frame would stand
    still otherwise.
    On leaving, the copy is gone and, without a window, the scene's own frame is evaluated again. With one it was never
    touched, and an artist's pose that has no key yet would be lost.
    """
    source, layer = bpy.context.scene, bpy.context.view_layer
    keep = shown_objects(source, layer) if objects is None else list(objects)
    stage = source.copy()
    try:
        for other in [x for x in stage.view_layers if x.name != layer.name]:
            stage.view_layers.remove(other)
        for child in stage.view_layers[0].layer_collection.children:
            child.exclude = True  # to unlink them has crashed Blender 5.2 while a 3D view was rendering
        for ob in list(stage.collection.objects):
            stage.collection.objects.unlink(ob)
        for ob in keep:
            if lights if ob.type == "LIGHT" else ob.type not in _TYPES_LEFT_OUT and not ob.is_shadow_catcher:
                stage.collection.objects.link(ob)
        stage.timeline_markers.clear()  # those with a camera would switch to it
        stage.background_set = None
        if bpy.app.background:
            source.user_remap(stage)
        yield stage
    finally:
        if bpy.app.background:
            stage.user_remap(source)
        stage.render.use_persistent_data = False  # what a renderer keeps would look into the scene that is gone
        bpy.data.scenes.remove(stage)
        if bpy.app.background:
            source.frame_set(source.frame_current, subframe=source.frame_subframe)
