# SPDX-License-Identifier: GPL-3.0-or-later
"""One asset in a child process: started, listened to, and ended where it takes too long or too much.

The parent watches what the child holds in memory. A limit of the system's on its addresses would not do: Blender takes
a texture that finds no memory for one that is missing, and renders on.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from .errors import InputError
from .render_index import CRASHED, MEMORY, TIME

_EVERY = 0.05  # seconds between looks: what fills memory does it at some gigabytes a second


@dataclass(frozen=True)
class Limits:
    """What one asset may take; None: as much as it likes. InputError for what no child could keep to."""

    seconds: float | None = None  # by the clock
    memory: float | None = None  # gigabytes (2**30) that are really held

    def __post_init__(self):
        for name in ("seconds", "memory"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise InputError(f"--limit-{name} {value:g}: too small; give a number above 0.")
        if self.memory is not None and not Path("/proc/self/statm").exists():
            raise InputError("--limit-memory: this system does not tell what a process holds; drop it.")


def run_child(
    job: dict, receive: Callable[[dict], None], running: set[subprocess.Popen], limits: Limits | None = None
) -> float:
    """Runs one job (see `render_asset`) in a child process, which is in `running` meanwhile, and passes on its
    messages; its death is a message too, {"error": …, "status": …}. Returns the processor seconds that it took, its
    own children included; 0 where the system does not tell."""
    with tempfile.TemporaryDirectory(prefix="timesplat-", ignore_cleanup_errors=True) as tmp:
        job_file, log = Path(tmp) / "job.json", Path(tmp) / "log"
        job_file.write_text(json.dumps(job))
        command = [sys.executable, "-m", "timesplat.datagen.render_asset", str(job_file), str(log)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stdin=subprocess.DEVNULL, text=True)
        running.add(process)
        said_error, ended, verdict = False, threading.Event(), []
        watcher = threading.Thread(target=_watch, args=(process, limits or Limits(), ended, verdict), daemon=True)
        watcher.start()
        try:
            for line in process.stdout:
                try:
                    message = json.loads(line)
                except ValueError:  # the last line of one that was killed
                    continue
                said_error |= "error" in message
                receive(message)
            code, spent = _wait(process)
        finally:
            ended.set()
            process.kill()
            process.wait()
            watcher.join()
            running.discard(process)
            remove_half_written(job)
        if code and not said_error:
            receive(_death(job["asset"]["path"], code, log, verdict[0] if verdict else "", limits))
    return spent


def render_job(
    job: dict, receive: Callable[[dict], None], running: set[subprocess.Popen], limits: Limits | None = None
) -> dict:
    """`run_child`, and what became of the job: {"written": folders, "error": the first such message or None, "seconds":
    by the clock, "cpu_seconds": of the processor}. `receive` gets all other messages. It never raises for a job."""
    start, spent, written, errors = time.monotonic(), 0.0, [], []

    def sort(message: dict) -> None:
        if "written" in message:
            written.append(message["written"])
        elif "error" in message:
            errors.append(message)
        else:
            receive(message)

    try:
        spent = run_child(job, sort, running, limits)
    except OSError as e:  # no process, no file could be made
        path = job["asset"]["path"]
        errors.append({"error": f"{path}: it could not be started ({e}); try again.", "status": CRASHED})
    error, seconds = next(iter(errors), None), time.monotonic() - start
    return {"written": written, "error": error, "seconds": seconds, "cpu_seconds": spent}


def _wait(process: subprocess.Popen) -> tuple[int, float]:
    """The exit code, negative for a signal, and processor seconds, of a child and of its own; 0 where that is not
    told."""
    try:
        _, status, usage = os.wait4(process.pid, 0)
    except (AttributeError, ChildProcessError):  # Windows; `_watch` was first to see that it is gone
        return process.wait(), 0.0
    process.returncode = os.waitstatus_to_exitcode(status)
    return process.returncode, usage.ru_utime + usage.ru_stime


def _death(path: str, code: int, log: Path, verdict: str, limits: Limits | None) -> dict:
    """The message of a child that died without a word."""
    if verdict == TIME:
        sentence = f"{path}: it takes longer than --limit-seconds {limits.seconds:g}; allow more, or leave it out."
        return {"error": sentence, "status": TIME}
    if verdict == MEMORY:
        sentence = f"{path}: it needs more than --limit-memory {limits.memory:g} (GB); allow more, or leave it out."
        return {"error": sentence, "status": MEMORY}
    reason = f"signal {-code}" if code < 0 else f"exit code {code}"
    lines = log.read_text("utf-8", errors="replace").strip().splitlines() if log.exists() else []
    last = f", last line: {lines[-1][:200]}" if lines else ""
    return {"error": f"{path}: Blender died on it ({reason}{last}); repair or leave out the file.", "status": CRASHED}


def _watch(process: subprocess.Popen, limits: Limits, ended: threading.Event, verdict: list[str]) -> None:
    """Kills the process when it goes beyond a limit, and notes which."""
    if limits == Limits():
        return
    start = time.monotonic()
    while not ended.wait(_EVERY):
        if limits.seconds is not None and time.monotonic() - start > limits.seconds:
            verdict.append(TIME)
        elif limits.memory is not None and held(process.pid) > limits.memory * 2**30:
            verdict.append(MEMORY)
        if verdict:
            process.kill()
            return


def held(pid: int) -> int:
    """Bytes of memory that a process really holds; 0 for one that is gone."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, IndexError, ValueError):
        return 0


def remove_half_written(job: dict) -> None:
    """Removes what a killed child left behind: `write_sequence` works in a hidden folder."""
    if "folder" in job:
        folder = Path(job["folder"])
        hidden = folder.parent.glob(f".{folder.name}.*")
    else:
        hidden = Path(job["out"]).glob(".*")
    for path in hidden:
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
