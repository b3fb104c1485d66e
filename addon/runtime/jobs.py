# SPDX-License-Identifier: GPL-3.0-or-later
"""All Jobs of this Blender, and the timer that looks after them.

A Job lives in Python and in a folder of its own, not in the .blend: undo, saving and opening another file do not
touch it. What it brings back it hands to `finish` on the main thread: at once where nothing else is under way,
otherwise the Job waits, and a click brings it in.
"""

from __future__ import annotations

import atexit
from collections.abc import Callable
from pathlib import Path

import bpy
from bpy.app.handlers import persistent

from ...datagen.sequence import InputError
from . import child_process, run_folders
from .folders import user_folder
from .job import Job

POLL_INTERVAL = 0.25  # seconds between two looks at the processes
MOST_LISTED = 8  # Jobs; older ones that have ended are forgotten
JOBS: list[Job] = []
_file_number = 0  # counts the files that were opened


def start(
    label: str,
    stages: list[Callable[[Path], child_process.Child]],
    finish=None,
    expected: list[float] | None = None,
    scene: str | None = None,
    partly: str = "",
) -> Job:
    """Starts a Job: `stages` run one after another, each is called with the Job's folder and starts a process;
    `expected` are the seconds that each will take, roughly (default: not known, and equal parts of the progress).
    `finish(event, folder)` gets the last stage's "done" event and returns the message to show; where `scene` is named
    it brings something into this scene, and is called when that can be done. `partly`: what stands before the message
    where the first stage has done its part for good and a later one fails or is cancelled. Raises InputError where the
    first cannot be started."""
    sweep()
    try:
        job = Job(label, stages, finish, expected, scene, partly, _file_number)
    except OSError as e:
        raise InputError(f"{user_folder('runs')}: it cannot be written ({e.strerror or e}); make room there.") from None
    ended = [j for j in JOBS if not j.active]
    for old in ended[: max(0, len(JOBS) - MOST_LISTED + 1)]:
        JOBS.remove(old)
    JOBS.append(job)
    if not bpy.app.background and not bpy.app.timers.is_registered(_poll_jobs):
        bpy.app.timers.register(_poll_jobs, first_interval=POLL_INTERVAL, persistent=True)
    return job


def wait(job: Job, report: Callable[[Job], None] = lambda job: None) -> None:
    """Stays with the Job until it has ended, for scripts and `blender -b`; `report` is called on the way. Raises
    InputError if it failed."""
    try:
        while job.state == "running":
            if job.advance(POLL_INTERVAL):
                report(job)
        if job.state == "waiting":
            job.bring_in()
    finally:
        job.cancel()
    if job.state != "done":
        raise InputError(job.message)


def running() -> list[Job]:
    """The Jobs whose processes run."""
    return [job for job in JOBS if job.state == "running"]


def sweep() -> None:
    """Removes the folders of runs that nobody needs any more."""
    run_folders.sweep([job.folder for job in JOBS if job.active])


def cancel_all() -> None:
    """Ends all Jobs and forgets them."""
    for job in JOBS:
        job.cancel()
    JOBS.clear()


def redraw(job: Job) -> None:
    """The status bar, with how far this Job is, and every area that shows Jobs."""
    text = f"Timesplat: {job.text}, {job.fraction:.0%} (Esc over a 3D view cancels)"
    for workspace in bpy.data.workspaces:
        workspace.status_text_set(text if running() else None)
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type in ("VIEW_3D", "PREFERENCES", "PROPERTIES"):
                area.tag_redraw()


def _poll_jobs() -> float | None:
    """The timer: every Job once."""
    changed = [job for job in JOBS if job.advance()]
    for job in JOBS:
        if job.state == "waiting" and _may_come_in(job):
            window = bpy.context.window_manager.windows[0]
            with bpy.context.temp_override(window=window):
                job.bring_in()
                if job.scene:
                    bpy.ops.ed.undo_push(message=job.label)
            changed.append(job)
    if changed:
        redraw(changed[-1])
    return POLL_INTERVAL if any(job.active for job in JOBS) else None


def _may_come_in(job: Job) -> bool:
    """Whether the result may come in by itself: the same file and scene, Object Mode, no tool in the artist's hand."""
    if not job.scene:
        return True
    windows = bpy.context.window_manager.windows
    if job.file_number != _file_number or not windows or windows[0].scene.name != job.scene:
        return False
    with bpy.context.temp_override(window=windows[0]):
        return bpy.context.mode == "OBJECT" and not any(len(w.modal_operators) for w in windows)


@persistent
def _count_opened_file(*_) -> None:
    global _file_number
    _file_number += 1


atexit.register(cancel_all)


def register() -> None:
    bpy.app.handlers.load_post.append(_count_opened_file)


def unregister() -> None:
    cancel_all()
    child_process.kill_all()
    if bpy.app.timers.is_registered(_poll_jobs):
        bpy.app.timers.unregister(_poll_jobs)
    bpy.app.handlers.load_post.remove(_count_opened_file)
