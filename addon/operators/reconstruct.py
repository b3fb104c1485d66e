# SPDX-License-Identifier: GPL-3.0-or-later
"""`bpy.ops.timesplat.reconstruct()`: cameras × frames of the scene are rendered by a Blender of its own, a worker
turns the pictures into 4D Gaussians, and these come back as a point cloud over the original.

From the panel it is a Job, and the artist goes on working. Called from a script or with `blender -b` it returns
when all is done.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import bpy
from bpy.props import StringProperty
from mathutils import Matrix

from ...datagen.sequence import InputError
from ...model.io.ply import read_ply, write_ply
from .. import estimates, settings
from ..asset.display import add_asset
from ..asset.parenting import follow
from ..asset.visibility import show
from ..notices import refuse_views_from_outside
from ..runtime import child_process, jobs, worker_options
from ..runtime.capture import start_capture
from .common import errors_reported


class TIMESPLAT_OT_reconstruct(settings.Settings, bpy.types.Operator):
    """Render the chosen cameras and frames, and reconstruct the object as 4D Gaussians"""

    bl_idname = "timesplat.reconstruct"
    bl_label = "Reconstruct"

    checkpoint: StringProperty(
        name="Checkpoint", description="Weights to use; empty: those of the preferences", subtype="FILE_PATH"
    )

    @classmethod
    def poll(cls, context):
        cls.poll_message_set("Reconstruct works in Object Mode; leave the mode that you are in.")
        return context.mode == "OBJECT"

    def invoke(self, context, event):
        with errors_reported(self):
            start(self, context)
            self.report({"INFO"}, "Reconstructing; Esc over a 3D view cancels.")
            return {"FINISHED"}
        return {"CANCELLED"}

    def execute(self, context):
        with errors_reported(self):
            job = start(self, context)
            jobs.wait(job)
            if not bpy.app.background:
                bpy.ops.ed.undo_push(message=self.bl_label)
            self.report({"INFO"}, job.message)
            return {"FINISHED"}
        return {"CANCELLED"}


def request(chosen, context) -> dict:
    """What these settings ask of `capture`, but for the folder to write. Raises InputError."""
    cameras, _ = settings.cameras(context)
    for ob in cameras:
        if ob.data.type != "PERSP":
            raise InputError(f"{ob.name}: the camera is not a perspective one; change its type or unselect it.")
    objects = settings.objects(chosen, context)
    method = settings.method(chosen, objects)
    return {
        "objects": [o.name_full for o in objects],
        "cameras": [o.name_full for o in cameras],
        "frames": list(settings.frames(chosen, context.scene)),
        "last": settings.span(chosen, context.scene)[1] if method == "tracks" else None,
        "in_turn": chosen.in_turn,
        "size": chosen.size,
        "samples": chosen.samples,
        "passes": method != "deform",
        "tracks": (chosen.number if chosen.budget == "NUMBER" else 0) if method == "tracks" else None,
        "lighting": chosen.lighting,
    }


def start(chosen, context) -> jobs.Job:
    """Starts the Job that these settings ask for. Raises InputError before anything has been done."""
    python = worker_options.worker_python(context)
    shot = request(chosen, context)
    refuse_views_from_outside(chosen, context)
    method = settings.method(chosen, settings.objects(chosen, context))
    checkpoint = bpy.path.abspath(chosen.checkpoint) if getattr(chosen, "checkpoint", "") else ""
    if checkpoint and not Path(checkpoint).is_file():
        raise InputError(f"{checkpoint}: no such checkpoint; correct it, or leave it empty.")
    output = _output(chosen.output)
    expected = estimates.estimate(chosen, context)
    pixels = expected.pictures * chosen.size**2
    begun = time.monotonic()

    def render(folder: Path) -> child_process.Child:
        return start_capture(shot | {"sequence": str(folder / "sequence")}, folder)

    def reconstruct(folder: Path) -> child_process.Child:
        estimates.learn_speed(time.monotonic() - begun, pixels, shot["samples"])
        places = {"sequence": str(folder / "sequence"), "asset": str(folder / "asset.ply")}
        return child_process.start_worker(python, asked | places, folder)

    # The operator is gone by the time that a stage or the end comes: what they need is taken from it now.
    look, size = chosen.look, chosen.size
    number = chosen.number if chosen.budget == "NUMBER" else 0
    asked = {
        "task": "reconstruct",
        "method": method,
        **settings.fit(chosen),
        "budget": settings.budget(chosen),
        "device": worker_options.device(context),
        "checkpoint": checkpoint or worker_options.checkpoint(context),
    }
    originals = _Originals.of(settings.objects(chosen, context))

    def finish(event: dict, folder: Path) -> str:
        asset = read_ply(folder / "asset.ply")
        estimates.learn_pace(event.get("seconds", 0.0), expected.reconstructing)
        method = event.get("method", asked["method"])
        fitted = asked["quality"] or (
            asked["refine"] and method not in ("tracks", "deform")
        )  # a fit of tracks keeps nearly all
        if not (asked["budget"] or fitted):  # else their number is not the pixels' alone
            estimates.learn_number(method, len(asset), expected.pictures, size)
        ob = add_asset(asset, "Timesplat", look=look, context=bpy.context)
        originals.note_in(ob)
        show(ob, originals.found(), "RESULT", bpy.context)
        ob["timesplat_lighting"] = shot["lighting"]
        said = f"{len(asset):,} Gaussians in {time.monotonic() - begun:.0f} s"
        if number and len(asset) < 0.9 * number:
            said += f" ({number:,} were asked for: more need a higher Resolution or Quality)"
        note = f" {event['note']}." if event.get("note") else ""
        if output:
            try:
                write_ply(output, asset)
            except InputError as e:  # the result is there; only the file is not
                return f"{said}, but {e}{note}"
        return f"{said}.{note}" if note else said

    seconds = [expected.rendering, expected.reconstructing]
    return jobs.start("Reconstruction", [render, reconstruct], finish, seconds, scene=context.scene.name)


@dataclass(frozen=True)
class _Originals:
    """The captured objects, as the end of a Job finds them again: names may change while it runs."""

    uids: frozenset[int]
    root: int  # uid of the one that all others hang on; 0 where there are several
    pose: Matrix  # of the root at the start

    @classmethod
    def of(cls, objects: list) -> _Originals:
        captured = [o for o in objects if o.type not in ("LIGHT", "CAMERA")]
        roots = [o for o in captured if o.parent not in captured]
        root, pose = (roots[0].session_uid, _pose(roots[0])) if len(roots) == 1 else (0, Matrix.Scale(0, 4))
        return cls(frozenset(o.session_uid for o in captured), root, pose)

    def found(self) -> list:
        """Those that are still in the scene."""
        return [o for o in bpy.context.scene.objects if o.session_uid in self.uids]

    def note_in(self, ob) -> None:
        """Notes their names in the asset object, and lets it follow the root."""
        found = {o.session_uid: o for o in self.found()}
        ob["timesplat_source"] = [o.name for o in found.values()]
        if self.pose.determinant() and self.root in found and follow(ob, found[self.root]):
            ob.matrix_parent_inverse = self.pose.inverted()  # it may have been moved since


def _pose(ob) -> Matrix:
    """Where an object stands by its own and its parents' settings: of a hidden one Blender evaluates nothing."""
    return (_pose(ob.parent) @ ob.matrix_parent_inverse if ob.parent else Matrix()) @ ob.matrix_basis


def _output(path: str) -> Path | None:
    """The .ply to keep, or None. Raises InputError where it could not be written."""
    if not path:
        return None
    place = Path(bpy.path.abspath(path))
    if place.suffix.lower() != ".ply":
        raise InputError(f"{place}: the name under Save As must end in .ply; correct it.")
    if not place.parent.is_dir():
        raise InputError(f"{place}: there is no such folder; choose another under Save As.")
    return place


def register() -> None:
    bpy.utils.register_class(TIMESPLAT_OT_reconstruct)


def unregister() -> None:
    bpy.utils.unregister_class(TIMESPLAT_OT_reconstruct)
