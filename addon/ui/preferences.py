# SPDX-License-Identifier: GPL-3.0-or-later
"""The add-on's preferences: what is chosen for the worker, and the installed runtime with its buttons."""

from __future__ import annotations

import bpy
from bpy.props import EnumProperty, StringProperty

from ..operators import runtime_buttons
from ..operators.runtime_buttons import OFFLINE, megabytes, wrapped_label
from ..runtime import jobs, worker_options
from ..runtime.folders import ADDON
from . import job_rows

DEVICES = [
    ("cpu", "CPU", "The processor: runs everywhere"),
    ("cuda", "CUDA", "An NVIDIA GPU; needs a runtime with CUDA"),
    ("mps", "Metal", "A GPU of Apple"),
]
SHOWN_VERSIONS = ("numba", "numpy", "usd-core", "OpenEXR")


def _look_for_python(preferences, context) -> None:
    worker_options.look_for_named_python()


class TIMESPLAT_preferences(bpy.types.AddonPreferences):
    bl_idname = ADDON

    python: StringProperty(
        name="Python",
        description="An interpreter with torch and the rest of timesplat[torch]. Empty: the installed runtime, else "
        "TIMESPLAT_PYTHON, else Blender's own",
        subtype="FILE_PATH",
        update=_look_for_python,
    )
    checkpoint: StringProperty(
        name="Checkpoint",
        description="Weights (.safetensors) in place of those that come with Timesplat",
        subtype="FILE_PATH",
    )
    device: EnumProperty(name="Device", description="Where networks and refinement run", items=DEVICES, default="cpu")

    def draw(self, context):
        layout = self.layout
        layout.use_property_split = True
        layout.prop(self, "python")
        layout.prop(self, "checkpoint")
        layout.prop(self, "device")
        _draw_runtime(layout)


def _draw_runtime(layout) -> None:
    """The part of the preferences below the settings; reads no files."""
    box = layout.box()
    box.use_property_split = False
    runtime = worker_options.installed_runtime()
    if named := worker_options.named_python():
        there = worker_options.is_named_python_there()
        said = f"{named} is used; Self-Test says whether it has all" if there else f"{named}: there is no such file"
        wrapped_label(box, f"Python: {said}.", "CHECKMARK" if there else "ERROR")
    elif runtime:
        versions = runtime["versions"]
        text = f"Runtime: torch {versions.get('torch')} ({runtime['build'].upper()})"
        box.label(text=f"{text}, {megabytes(runtime['bytes'])}", icon="CHECKMARK")
        box.label(text=", ".join(f"{k} {v}" for k, v in versions.items() if k in SHOWN_VERSIONS), icon="BLANK1")
    else:
        box.label(text="Runtime: not installed", icon="IMPORT")
        if not bpy.app.online_access:
            wrapped_label(box, OFFLINE, "INTERNET_OFFLINE")
    row = box.row(align=True)
    row.operator_context = "INVOKE_DEFAULT"
    if jobs.running():
        row.enabled = False
    row.operator("timesplat.install_runtime", text="Install Again" if runtime else "Install Runtime", icon="IMPORT")
    row.operator("timesplat.uninstall_runtime", text="Uninstall", icon="TRASH")
    row.operator("timesplat.self_test", icon="CHECKMARK")
    if runtime_buttons.last_job in jobs.JOBS:
        _draw_progress(box, runtime_buttons.last_job)
    runtime_buttons.draw_report(box)


def _draw_progress(box, job) -> None:
    row = box.row(align=True)
    if job.state == "running":
        row.progress(factor=job.fraction, text=f"{job.label}: {job.text}")
        row.operator("timesplat.cancel", text="", icon="X").number = job.number
    else:
        wrapped_label(row, job.message or job.text, job_rows.STATE_ICONS[job.state])
        if job.state == "waiting":
            row.operator("timesplat.bring", text="", icon="IMPORT").number = job.number
    row.operator("timesplat.log", text="", icon="TEXT").number = job.number


def register() -> None:
    bpy.utils.register_class(TIMESPLAT_preferences)
    worker_options.reload_installed_runtime()
    worker_options.look_for_named_python()


def unregister() -> None:
    bpy.utils.unregister_class(TIMESPLAT_preferences)
