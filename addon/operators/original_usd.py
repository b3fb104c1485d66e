# SPDX-License-Identifier: GPL-3.0-or-later
"""What an asset was made from as USD, by Blender's own exporter: for export with With Original."""

from __future__ import annotations

import tempfile
from contextlib import contextmanager
from pathlib import Path

import bpy

from ...datagen.sequence import InputError
from ...model.io.atomic import atomic_write


@contextmanager
def original_usd(ob, path: Path, frames: range, context):
    """Yields a .usdc of the objects that the asset was made from, over these frames: a temporary one for a .usdz, which
    takes it in, else <name>_original.usdc beside `path`, which refers to it. Raises InputError."""
    if path.suffix.lower() == ".usdz":
        with tempfile.TemporaryDirectory(prefix="timesplat-", ignore_cleanup_errors=True) as folder:
            _export_original(ob, Path(folder) / "original.usdc", frames, context)
            yield Path(folder) / "original.usdc"
        return
    beside = path.with_name(f"{path.stem}_original.usdc")
    new = not beside.exists()
    with atomic_write(beside) as tmp:
        _export_original(ob, tmp, frames, context)
    try:
        yield beside
    except InputError:
        if new:
            beside.unlink(missing_ok=True)
        raise


def _export_original(ob, path: Path, frames: range, context) -> None:
    """Blender's own USD export; selection, visibility and frame range are afterwards as they were."""
    if not bpy.app.build_options.usd:
        raise InputError("This Blender was built without USD, which With Original needs; switch that off.")
    layer, scene = context.view_layer, context.scene
    objects = [layer.objects[n] for n in ob.get("timesplat_source", []) if n in layer.objects]
    if not objects:
        raise InputError(f"{ob.name}: what it was made from is not in this view layer; switch With Original off.")
    before = [(o, o.hide_get(), o.hide_viewport) for o in objects]
    selected, active = list(layer.objects.selected), layer.objects.active
    span, now = (scene.frame_start, scene.frame_end), (scene.frame_current, scene.frame_subframe)
    why = "see its console"
    try:
        for o in selected:
            o.select_set(False)
        for o in objects:
            o.hide_viewport = False
            o.hide_set(False)
            o.select_set(True)
        scene.frame_start, scene.frame_end = frames.start, frames.stop - 1
        bpy.ops.wm.usd_export(
            filepath=str(path),
            selected_objects_only=True,
            export_animation=True,
            export_armatures=False,  # deformed meshes at every frame, which every reader shows
            export_shapekeys=False,
            convert_world_material=False,
        )
    except RuntimeError as e:
        why = " ".join(str(e).split())
    finally:
        scene.frame_start, scene.frame_end = span
        scene.frame_set(now[0], subframe=now[1])
        for o, hidden, off in before:
            o.select_set(False)
            o.hide_set(hidden)
            o.hide_viewport = off
        for o in selected:
            o.select_set(True)
        layer.objects.active = active
    if not path.is_file():
        raise InputError(f"{ob.name}: Blender could not export what it was made from ({why}); do without it.")
