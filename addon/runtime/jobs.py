# SPDX-License-Identifier: GPL-3.0-or-later
"""What runs beside Blender: Jobs, each a chain of child processes, their progress, their end and their logs.

A Job lives in Python and in a folder of its own, not in the .blend: undo, saving and opening another file do not
touch it. A timer looks after all of them. What a Job brings back it hands to `finish` on the main thread: at once
where nothing else is under way, otherwise the Job waits, and a click brings it in. Whatever happens, a Job that has
ended leaves neither a process nor a file behind.
"""

from __future__ import annotations

import atexit
import contextlib
import itertools
import os
import shutil
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path

import bpy
from bpy.app.handlers import persistent

from ...datagen.sequence import WINDOWS, InputError
from . import child_process
from .folders import user_folder

INTERVAL = 0.25  # seconds between two looks
KEPT = 8  # Jobs that are listed; older ones that have ended are forgotten
JOBS: list[Job] = []
_numbers = itertools.count(1)
_session = 0  # counts the files that were opened


class Job:
    """state: running, waiting (for `bring`), done, failed or cancelled; fraction 0..1 and text: how far it is;
    message: how it ended."""

    def __init__(self, label: str, stages: list, finish, shares, scene: str | None, partly: str = "") -> None:
        self.label, self.number, self.session, self.scene = label, next(_numbers), _session, scene
        self.state, self.fraction, self.text, self.message = "running", 0.0, "starting", ""
        self._stages, self._finish = list(stages), finish
        self._shares = list(shares or [1 / len(stages)] * len(stages))
        self._before, self._log, self._event = 0.0, "", {}
        self._partly, self._kept = partly, ""
        self.folder = Path(tempfile.mkdtemp(prefix=f"run-{os.getpid()}-", dir=user_folder("runs")))
        self.child: child_process.Child | None = None
        try:
            self._next()
        except BaseException:
            self._end("failed", "")
            raise

    def _next(self) -> None:
        self.child = self._stages.pop(0)(self.folder)

    def step(self, timeout: float | None = None) -> bool:
        """Takes in what the processes said, starts the next; True where something changed."""
        if self.state != "running":
            return False
        events = self.child.poll(timeout)
        try:
            for event in events:
                self._take(event)
        except InputError as e:
            self._end("failed", str(e))
        except Exception as e:  # a timer that raises is never called again
            self._fail("The next step cannot be started", e)
        return bool(events)

    def _take(self, event: dict) -> None:
        if event["event"] == "progress":
            self.fraction, self.text = self._before + self._shares[0] * event["fraction"], event["text"]
        elif event["event"] == "error":
            self._end("failed", event["message"])
        else:
            self._before += self._shares.pop(0)
            self.fraction = self._before
            self.child.kill()  # it has said all; what it leaves running goes too
            if self._stages:
                self._kept = self._partly
                self._next()
            else:
                self._event, self.state, self.text = event, "waiting", "done"

    def _fail(self, what: str, error: Exception) -> None:
        self._log += traceback.format_exc()
        self._end("failed", f"{what}: {type(error).__name__}: {' '.join(str(error).split())[:300]}")

    def bring(self) -> None:
        """Hands the result over, in Object Mode; the Job is done then, or has failed."""
        try:
            message = self._finish(self._event, self.folder) if self._finish else self.label
        except InputError as e:
            self._end("failed", str(e))
        except Exception as e:
            self._fail("The result cannot be brought in", e)
        else:
            self._end("done", message)

    def cancel(self) -> None:
        """Ends it, now; harmless where it has ended."""
        if self.state in ("running", "waiting"):
            self._end("cancelled", "Cancelled.")

    def _end(self, state: str, message: str) -> None:
        if self.child:
            self.child.kill()
        self._log = self.log_text()
        said = message if state == "done" else f"{self._kept} {message}".strip()
        self.child, self.state, self.message, self.text = None, state, said, ""
        for _ in range(10):
            shutil.rmtree(self.folder, ignore_errors=True)
            if not self.folder.exists():
                break
            time.sleep(0.05)  # what was killed may be in the middle of its last write

    def log_text(self) -> str:
        """All that its processes wrote, or the beginning and the end of it."""
        return self._log + (self.child.log_text() if self.child else "")


def start(
    label: str,
    stages: list[Callable[[Path], child_process.Child]],
    finish=None,
    shares=None,
    scene: str | None = None,
    partly: str = "",
) -> Job:
    """Starts a Job: `stages` run one after another, each is called with the Job's folder and starts a process;
    `shares` are their parts of the progress (default: equal ones). `finish(event, folder)` gets the last stage's
    "done" event and returns the message to show; where `scene` is named it brings something into this scene, and
    is called when that can be done. `partly`: what stands before the message where the first stage has done its part
    for good and a later one fails or is cancelled. Raises InputError where the first cannot be started."""
    sweep()
    try:
        job = Job(label, stages, finish, shares, scene, partly)
    except OSError as e:
        raise InputError(f"{user_folder('runs')}: it cannot be written ({e.strerror or e}); make room there.") from None
    ended = [j for j in JOBS if j.state not in ("running", "waiting")]
    for old in ended[: max(0, len(JOBS) - KEPT + 1)]:
        JOBS.remove(old)
    JOBS.append(job)
    if not bpy.app.background and not bpy.app.timers.is_registered(_look):
        bpy.app.timers.register(_look, first_interval=INTERVAL, persistent=True)
    return job


def wait(job: Job, report: Callable[[Job], None] = lambda job: None) -> None:
    """Stays with the Job until it has ended, for scripts and `blender -b`; `report` is called on the way. Raises
    InputError if it failed."""
    try:
        while job.state == "running":
            if job.step(INTERVAL):
                report(job)
        if job.state == "waiting":
            job.bring()
    finally:
        job.cancel()
    if job.state != "done":
        raise InputError(job.message)


def running() -> list[Job]:
    """The Jobs whose processes run."""
    return [job for job in JOBS if job.state == "running"]


def _look():
    """The timer: every Job once."""
    changed = [job for job in JOBS if job.step()]
    for job in JOBS:
        if job.state == "waiting" and _quiet(job):
            window = bpy.context.window_manager.windows[0]
            with bpy.context.temp_override(window=window):
                job.bring()
                if job.scene:
                    bpy.ops.ed.undo_push(message=job.label)
            changed.append(job)
    if changed:
        redraw(changed[-1])
    return INTERVAL if any(job.state in ("running", "waiting") for job in JOBS) else None


def _quiet(job: Job) -> bool:
    """Whether the result may come in by itself: the same file and scene, Object Mode, no tool in the artist's hand."""
    if not job.scene:
        return True
    windows = bpy.context.window_manager.windows
    if job.session != _session or not windows or windows[0].scene.name != job.scene:
        return False
    with bpy.context.temp_override(window=windows[0]):
        return bpy.context.mode == "OBJECT" and not any(len(w.modal_operators) for w in windows)


def redraw(job: Job) -> None:
    """The status bar, with how far this Job is, and every area that shows Jobs."""
    text = f"Timesplat: {job.text}, {job.fraction:.0%} (Esc over a 3D view cancels)"
    for workspace in bpy.data.workspaces:
        workspace.status_text_set(text if running() else None)
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type in ("VIEW_3D", "PREFERENCES", "PROPERTIES"):
                area.tag_redraw()


def sweep() -> None:
    """Removes from the folder of runs what Blenders that are gone left, and what ended Jobs of this one could not
    remove because something still held it."""
    kept = [job.folder for job in JOBS if job.state in ("running", "waiting")]
    for folder in user_folder("runs").glob("run-*-*"):
        with contextlib.suppress(ValueError):
            pid = int(folder.name.split("-")[1])
            if not (folder in kept if pid == os.getpid() else _alive(pid)):
                shutil.rmtree(folder, ignore_errors=True)


def _alive(pid: int) -> bool:
    if WINDOWS:  # where os.kill ends whatever it is asked about
        import _winapi

        try:
            handle = _winapi.OpenProcess(_winapi.SYNCHRONIZE, False, pid)
        except PermissionError:
            return True
        except OSError:
            return False
        try:
            return _winapi.WaitForSingleObject(handle, 0) == _winapi.WAIT_TIMEOUT
        finally:
            _winapi.CloseHandle(handle)
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True


# ---------------------------------------------------------------- with Blender


@persistent
def _opened(*_) -> None:
    global _session
    _session += 1


def close() -> None:
    """Ends all Jobs."""
    for job in JOBS:
        job.cancel()
    JOBS.clear()


atexit.register(close)


def register() -> None:
    bpy.app.handlers.load_post.append(_opened)


def unregister() -> None:
    close()
    child_process.kill_all()
    if bpy.app.timers.is_registered(_look):
        bpy.app.timers.unregister(_look)
    bpy.app.handlers.load_post.remove(_opened)
