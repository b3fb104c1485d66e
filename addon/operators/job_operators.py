# SPDX-License-Identifier: GPL-3.0-or-later
"""What can be done with a Job: cancel it (Esc over a 3D view, too), bring its result in, show its log."""

from __future__ import annotations

import bpy
from bpy.props import IntProperty

from ..runtime import jobs


class _OfJob:
    """An operator on one of the Jobs."""

    number: IntProperty(description="The Job's number; 0: the newest", min=0, options={"SKIP_SAVE"})

    def chosen_job(self) -> jobs.Job | None:
        return next((j for j in reversed(jobs.JOBS) if self.number in (0, j.number)), None)


class TIMESPLAT_OT_cancel(_OfJob, bpy.types.Operator):
    """End what runs, or throw away what waits; the scene is as it was"""

    bl_idname = "timesplat.cancel"
    bl_label = "Cancel Job"

    @classmethod
    def poll(cls, context):
        return any(job.active for job in jobs.JOBS)

    def invoke(self, context, event):
        if event.type == "ESC":
            own = [job for job in jobs.running() if job.scene]  # an installation is not ended in passing
            if not own or context.screen.is_animation_playing:
                return {"PASS_THROUGH"}  # Esc means something else then
            self.number = own[-1].number
        return self.execute(context)

    def execute(self, context):
        job = self.chosen_job() if self.number else (jobs.running() or jobs.JOBS)[-1]
        if job:
            job.cancel()
            jobs.redraw(job)
            self.report({"INFO"}, f"{job.label}: cancelled.")
        return {"FINISHED"}


class TIMESPLAT_OT_bring(_OfJob, bpy.types.Operator):
    """Bring the result into this scene"""

    bl_idname = "timesplat.bring"
    bl_label = "Bring In Result"
    bl_options = {"UNDO"}  # noqa: RUF012

    @classmethod
    def poll(cls, context):
        return context.mode == "OBJECT" and any(job.state == "waiting" for job in jobs.JOBS)

    def execute(self, context):
        job = self.chosen_job()
        if job and job.state == "waiting":
            job.bring_in()
            self.report({"INFO"} if job.state == "done" else {"ERROR"}, job.message)
        return {"FINISHED"}


class TIMESPLAT_OT_log(_OfJob, bpy.types.Operator):
    """Show the log as a text, in a window of its own"""

    bl_idname = "timesplat.log"
    bl_label = "Show Log"

    @classmethod
    def poll(cls, context):
        return bool(jobs.JOBS)

    def execute(self, context):
        job = self.chosen_job()
        if not job:
            return {"CANCELLED"}
        text = bpy.data.texts.get("Timesplat log") or bpy.data.texts.new("Timesplat log")
        text.from_string(f"{job.label}: {job.message or job.text}\n\n{job.log_text() or 'It said nothing.'}")
        if not bpy.app.background:
            show_text(context, text)
        return {"FINISHED"}


def show_text(context, text) -> None:
    """Opens a text in a window of its own."""
    bpy.ops.wm.window_new()
    area = context.window_manager.windows[-1].screen.areas[0]
    area.type = "TEXT_EDITOR"
    area.spaces.active.text = text


CLASSES = (TIMESPLAT_OT_cancel, TIMESPLAT_OT_bring, TIMESPLAT_OT_log)
_keymap_items: list = []
register_classes, unregister_classes = bpy.utils.register_classes_factory(CLASSES)


def register() -> None:
    register_classes()
    if keys := bpy.context.window_manager.keyconfigs.addon:  # none in background
        keymap = keys.keymaps.new(name="3D View", space_type="VIEW_3D")
        _keymap_items.append((keymap, keymap.keymap_items.new("timesplat.cancel", "ESC", "PRESS")))


def unregister() -> None:
    for keymap, item in _keymap_items:
        keymap.keymap_items.remove(item)
    _keymap_items.clear()
    unregister_classes()
