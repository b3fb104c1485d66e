# SPDX-License-Identifier: GPL-3.0-or-later
"""A Job: a chain of child processes that run one after another in a folder of the Job's own, their progress, their end
and their log, with what Blender writes when it crashes. Whatever happens, a Job that has ended leaves neither a process
nor a file behind."""

from __future__ import annotations

import itertools
import time
import traceback
from collections.abc import Callable
from pathlib import Path

from ...datagen.sequence import InputError
from . import child_process, run_folders

PACE_SHOWS = 0.06  # of a stage: a capture has rendered its first picture then
_numbers = itertools.count(1)


class Job:
    """Starts with the first stage at once (stages, finish, expected, scene, partly: see `jobs.start`); file_number: of
    the opened file that it belongs to. state: running, waiting (for `bring_in`), done, failed or cancelled;
    fraction 0..1 and text: how far it is; message: how it ended. Raises what the first stage raises."""

    def __init__(
        self, label: str, stages: list, finish, expected, scene: str | None, partly: str = "", file_number: int = 0
    ) -> None:
        self.label, self.number, self.file_number, self.scene = label, next(_numbers), file_number, scene
        self.state, self.fraction, self.text, self.message = "running", 0.0, "starting", ""
        self._stages, self._finish = list(stages), finish
        self._expected = list(expected or [])  # seconds of this stage and those to come
        self._shares = [x / sum(expected) for x in expected] if expected else [1 / len(stages)] * len(stages)
        self._fraction_before, self._log, self._result = 0.0, "", {}
        self._stage_fraction, self._stage_begun = 0.0, time.monotonic()
        self._partly, self._stays = partly, ""  # _stays: what is there for good already, as the message's beginning
        self.folder = run_folders.make()
        self.child: child_process.Child | None = None
        try:
            self._start_next_stage()
        except BaseException:
            self._end("failed", "")
            raise

    @property
    def active(self) -> bool:
        """Whether it has not ended: it runs, or its result waits."""
        return self.state in ("running", "waiting")

    @property
    def seconds_left(self) -> float | None:
        """Until it ends, roughly: the present stage by its own pace, as soon as it has come some way (its first
        picture, say), and what comes after as was expected. None where nothing was."""
        if self.state != "running" or not self._expected:
            return None
        spent, done = time.monotonic() - self._stage_begun, self._stage_fraction
        now = spent * (1 - done) / done if done > PACE_SHOWS else max(self._expected[0] - spent, 0)
        return now + sum(self._expected[1:])

    def advance(self, timeout: float | None = None) -> bool:
        """Takes in what the processes said, starts the next; True where something changed. Waits up to `timeout`
        seconds for that."""
        if self.state != "running":
            return False
        events = self.child.poll(timeout)
        try:
            for event in events:
                self._handle(event)
        except InputError as e:
            self._end("failed", str(e))
        except Exception as e:  # a timer that raises is never called again
            self._fail("The next step cannot be started", e)
        return bool(events)

    def bring_in(self) -> None:
        """Hands the result over, in Object Mode; the Job is done then, or has failed."""
        try:
            message = self._finish(self._result, self.folder) if self._finish else self.label
        except InputError as e:
            self._end("failed", str(e))
        except Exception as e:
            self._fail("The result cannot be brought in", e)
        else:
            self._end("done", message)

    def cancel(self) -> None:
        """Ends it, now; harmless where it has ended."""
        if self.active:
            self._end("cancelled", "Cancelled.")

    def log_text(self) -> str:
        """All that its processes wrote, or the beginning and the end of it."""
        return self._log + (self.child.log_text() if self.child else "")

    def _start_next_stage(self) -> None:
        start: Callable[[Path], child_process.Child] = self._stages.pop(0)
        self.child = start(self.folder)

    def _handle(self, event: dict) -> None:
        if event["event"] == "progress":
            self._stage_fraction = event["fraction"]
            self.fraction = self._fraction_before + self._shares[0] * event["fraction"]
            self.text = event["text"]
        elif event["event"] == "error":
            self._end("failed", event["message"])
        else:
            self._fraction_before += self._shares.pop(0)
            self._expected = self._expected[1:]
            self._stage_fraction, self._stage_begun = 0.0, time.monotonic()
            self.fraction = self._fraction_before
            self.child.kill()  # it has said all; what it leaves running goes too
            if self._stages:
                self._stays = self._partly
                self._start_next_stage()
            else:
                self._result, self.state, self.text = event, "waiting", "done"

    def _fail(self, what: str, error: Exception) -> None:
        self._log += traceback.format_exc()
        self._end("failed", f"{what}: {type(error).__name__}: {' '.join(str(error).split())[:300]}")

    def _end(self, state: str, message: str) -> None:
        if self.child:
            self.child.kill()
        self._log = self.log_text()
        if state == "failed":
            self._log += run_folders.crash_logs(self.folder)
        self.message = message if state == "done" else f"{self._stays} {message}".strip()
        self.child, self.state, self.text = None, state, ""
        run_folders.remove(self.folder)
