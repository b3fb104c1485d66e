# SPDX-License-Identifier: GPL-3.0-or-later
"""The buttons in the preferences: install the model runtime (and test it at once, which compiles its kernels), take it
away, test it. Each is a Job (`jobs`); with `blender -b` the operators return when all is done. The network is asked
only by Install, and only where Blender's own setting allows it.
"""

from __future__ import annotations

import sys
import textwrap
from pathlib import Path

import bpy
from bpy.props import EnumProperty

from ...datagen.sequence import InputError
from ..runtime import child_process, folders, install, jobs, worker_options
from .common import errors_reported

BUILDS = [
    ("cpu", "CPU", "Runs everywhere: about 300 MB to fetch, 1.3 GB on disk"),
    ("cuda", "CUDA", "For NVIDIA GPUs: several GB to fetch, more on disk"),
]
OFFLINE = "Online access is off; Preferences > System > Network > Allow Online Access switches it on."
TITLE = "Timesplat self-test"
last_job: jobs.Job | None = None  # the one that was started here last
self_test_report: list[str] = []  # the lines of the last self-test


class _Button:
    """An operator that starts a Job, and in background stays with it."""

    def execute(self, context):
        global last_job
        with errors_reported(self):
            if busy := jobs.running():
                raise InputError(f"{busy[-1].label} runs; wait for its end, or cancel it.")
            last_job = self.start(context)
            if bpy.app.background:
                jobs.wait(last_job)
                self.report({"INFO"}, last_job.message)
            return {"FINISHED"}
        return {"CANCELLED"}


class TIMESPLAT_OT_install_runtime(_Button, bpy.types.Operator):
    """Fetch torch and all else that reconstruction needs into a folder of the add-on's own"""

    bl_idname = "timesplat.install_runtime"
    bl_label = "Install Runtime"

    build: EnumProperty(name="Build", items=BUILDS, default="cpu")

    def invoke(self, context, event):
        if not bpy.app.online_access:
            self.report({"ERROR"}, OFFLINE)
            return {"CANCELLED"}
        return context.window_manager.invoke_props_dialog(self, width=420, confirm_text="Install")

    def draw(self, context):
        layout = self.layout
        layout.row().prop(self, "build", expand=True)
        about = next(about for key, _, about in BUILDS if key == self.build)
        for line in (*textwrap.wrap(f"{about}.", 60), "Blender stays usable meanwhile, and Cancel is always possible."):
            layout.label(text=line)

    def start(self, context):
        if not bpy.app.online_access:
            raise InputError(OFFLINE)
        if self.build == "cuda" and sys.platform == "darwin":
            raise InputError("CUDA does not exist for this computer; choose CPU, which has Metal too.")
        stages = [_install_stage({"task": "install", "build": self.build}), _self_test_stage]
        return jobs.start("Install runtime", stages, _finish_install, [0.85, 0.15], partly="The runtime is installed.")


class TIMESPLAT_OT_uninstall_runtime(_Button, bpy.types.Operator):
    """Remove the installed runtime from the disk"""

    bl_idname = "timesplat.uninstall_runtime"
    bl_label = "Uninstall Runtime"

    @classmethod
    def poll(cls, context):
        return worker_options.installed_runtime() is not None

    def invoke(self, context, event):
        return context.window_manager.invoke_confirm(self, event)

    def start(self, context):
        return jobs.start("Uninstall runtime", [_install_stage({"task": "uninstall"})], _finish_uninstall)


class TIMESPLAT_OT_self_test(_Button, bpy.types.Operator):
    """See whether this computer reconstructs: packages, device, checkpoints, a small scene"""

    bl_idname = "timesplat.self_test"
    bl_label = "Self-Test"

    def start(self, context):
        python, request = worker_options.worker_python(context), _self_test_request(context)
        return jobs.start(
            "Self-test", [lambda folder: child_process.start_worker(python, request, folder)], _finish_self_test
        )


def _install_stage(request: dict):
    """A stage of a Job that runs `install` under Blender's own Python."""
    request = {**request, "folder": str(folders.runtime_folder())}
    command = [sys.executable, "-I", "-X", "utf8", str(Path(install.__file__))]
    return lambda folder: child_process.Child(command, {**request, "work": str(folder)}, folder)


def _self_test_request(context) -> dict:
    """What the worker is asked for. Raises InputError."""
    return {
        "task": "selftest",
        "device": worker_options.device(context),
        "checkpoint": worker_options.checkpoint(context),
    }


def _self_test_stage(folder: Path) -> child_process.Child:
    """The stage after the installation: the self-test of what was installed."""
    worker_options.reload_installed_runtime()
    python = folders.runtime_folder() / worker_options.installed_runtime()["python"]
    return child_process.start_worker(str(python), _self_test_request(bpy.context), folder)


def _finish_install(event: dict, folder: Path) -> str:
    runtime = worker_options.installed_runtime()
    verdict = _finish_self_test(event, folder)
    return f"Runtime installed: torch {runtime['versions']['torch']}, {megabytes(runtime['bytes'])} on disk. {verdict}"


def _finish_uninstall(event: dict, folder: Path) -> str:
    worker_options.reload_installed_runtime()
    return f"Runtime removed: {megabytes(event['bytes'])} freed."


def _finish_self_test(event: dict, folder: Path) -> str:
    self_test_report[:] = [str(line) for line in event["report"]]
    text = bpy.data.texts.get(TITLE) or bpy.data.texts.new(TITLE)
    text.from_string("\n".join(self_test_report) + "\n")
    failed = sum(not line.startswith("ok") for line in self_test_report)
    windows = bpy.context.window_manager.windows
    if bpy.app.background:
        print(text.as_string())
    elif not any(area.type == "PREFERENCES" for window in windows for area in window.screen.areas):
        icon = "ERROR" if failed else "CHECKMARK"
        bpy.context.window_manager.popup_menu(lambda menu, context: draw_report(menu.layout), title=TITLE, icon=icon)
    if failed:
        raise InputError(f"Self-test: {failed} of {len(self_test_report)} failed; the text {TITLE!r} says what to do.")
    return f"Self-test: all {len(self_test_report)} passed."


def megabytes(count: int) -> str:
    """Bytes as text, like "500 MB"."""
    return f"{count / 1e6:.0f} MB"


# ---------------------------------------------------------------- drawing


def draw_report(layout) -> None:
    """The lines of the last self-test: in the preferences, and where these are closed in a popup."""
    column = layout.column(align=True)
    for line in self_test_report:
        wrapped_label(column, line.removeprefix("ok "), "CHECKMARK" if line.startswith("ok") else "ERROR")


def wrapped_label(layout, text: str, icon: str) -> None:
    """A label as wide as the region, in as many lines as the text needs; the icon stands before the first."""
    column = layout.column(align=True)
    column.scale_y = 0.8
    region = bpy.context.region  # none in background
    width = (region.width / bpy.context.preferences.system.ui_scale - 120) / 6.5 if region else 90  # in characters
    for i, line in enumerate(textwrap.wrap(text, max(int(width), 40))):
        column.label(text=line, icon="BLANK1" if i else icon)


CLASSES = (TIMESPLAT_OT_install_runtime, TIMESPLAT_OT_uninstall_runtime, TIMESPLAT_OT_self_test)
register_classes, unregister_classes = bpy.utils.register_classes_factory(CLASSES)


def register() -> None:
    register_classes()


def unregister() -> None:
    global last_job
    last_job = None
    self_test_report.clear()
    unregister_classes()
