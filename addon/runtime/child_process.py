# SPDX-License-Identifier: GPL-3.0-or-later
"""Child processes that answer in JSON lines, read without ever waiting: the worker (`model.worker`) under a Python
that has torch, and a Blender without a window that renders (`background_blender`).

torch never comes into Blender's own process. A child gets one JSON object on its standard input and says
    {"event": "progress", "fraction": 0..1, "text": …}      as often as it likes
    {"event": "done", …} or {"event": "error", "message": one sentence}     once
on its standard output; what it writes to standard error is its log. Threads read both, the caller asks `poll`.
However much a child says, only its last progress, its end and MOST_LOG_BYTES of log are kept. The process and its
children die on `kill`, with the add-on, and with Blender itself (they leave when their standard input closes).
"""

from __future__ import annotations

import atexit
import contextlib
import json
import math
import os
import signal
import subprocess
import tempfile
import threading
import time
from pathlib import Path

from ...datagen.errors import InputError
from ...datagen.whole_folders import WINDOWS

PACKAGE = Path(__file__).resolve().parents[2]
# Imports this folder as the package `timesplat`, whatever the folder is called, and runs one module of it. (Its
# parent stays off the path: other extensions live there, with names that could hide real packages.)
LAUNCH = """
import importlib.util, runpy, sys
spec = importlib.util.spec_from_file_location("timesplat", {init!r}, submodule_search_locations=[{folder!r}])
package = sys.modules["timesplat"] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(package)
sys.argv[1:] = []
runpy.run_module("timesplat.{module}", run_name="__main__", alter_sys=True)
"""
MOST_LOG_BYTES = 1 << 20  # bytes of log that are kept in the file; beyond that only the end is remembered
LONGEST_LINE = 1 << 16  # bytes of a line that are looked at in one piece
BYTES_UNTIL_NAP = 1 << 20  # bytes between two naps of the reader, so that a child that floods waits, and not Blender
NAP_SECONDS = 0.02
# Of Windows: a process in a group of its own, and no console window for it or for what it starts.
NEW_GROUP, NO_WINDOW = 0x00000200, 0x08000000
_running: set[Child] = set()


def launch(module: str) -> str:
    """Python code that runs `timesplat.<module>` of this very folder."""
    return LAUNCH.format(init=str(PACKAGE / "__init__.py"), folder=str(PACKAGE), module=module)


def start_worker(python: str, request: dict, folder: Path) -> Child:
    """`model.worker` under the interpreter `python`, started at once (the request: see there)."""
    return Child([python, "-X", "utf8", "-c", launch("model.worker")], request, folder)


def ask_worker(python: str, request: dict) -> dict:
    """Runs a request to the worker to its end; for tasks of a few seconds. Returns the "done" event; raises
    InputError with what the worker said."""
    with tempfile.TemporaryDirectory(prefix="timesplat-", ignore_cleanup_errors=True) as folder:
        child = start_worker(python, request, Path(folder))
        try:
            while True:
                for event in child.poll(1.0):
                    if event["event"] == "done":
                        return event
                    if event["event"] == "error":
                        raise InputError(event["message"])
        finally:
            child.kill()


class Child:
    """One process, started at once. command: program and arguments; request: what it is asked; folder: an
    existing folder, where it runs, keeps temporary files and has its log (several may follow each other in it).
    Raises InputError where it cannot be started."""

    def __init__(self, command: list[str], request: dict, folder: Path) -> None:
        self.log = Path(folder) / "log.txt"
        self._news = threading.Condition()
        self._progress: dict | None = None
        self._end: dict | None = None
        self._end_reported = False
        self._tail = b""
        env = {k: v for k, v in os.environ.items() if k not in ("PYTHONHOME", "PYTHONPATH")}
        env |= {"PYTHONUNBUFFERED": "1", **dict.fromkeys(("TMPDIR", "TEMP", "TMP"), str(folder))}
        group = {"creationflags": NEW_GROUP | NO_WINDOW} if WINDOWS else {"start_new_session": True}
        pipe = subprocess.PIPE
        try:
            self.process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, cwd=folder, env=env, **group)
        except OSError as e:
            reason = e.strerror or e
            raise InputError(f"{command[0]}: it cannot be started ({reason}); choose another program.") from None
        _running.add(self)
        if not WINDOWS and signal.getsignal(signal.SIGPIPE) == signal.SIG_DFL:  # in Blender 4, which would end with it
            signal.signal(signal.SIGPIPE, signal.SIG_IGN)  # as Python has it
        with contextlib.suppress(OSError):  # it may be gone already; then the log says why
            self.process.stdin.write((json.dumps({**request, "watch": True}) + "\n").encode())
            self.process.stdin.flush()  # and it stays open: its end is the sign that Blender is gone
        self._logger = threading.Thread(target=self._keep_log, daemon=True)
        self._logger.start()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for line in _lines(self.process.stdout):
            event = _parse_event(line)
            with self._news:
                if event and self._end is None:
                    if event["event"] == "progress":
                        self._progress = event
                    else:
                        self._end = event
                    self._news.notify_all()
        self.process.wait()
        self._end_group()
        self._logger.join(10.0)  # what has left the group may hold the pipe
        with self._news:
            self._end = self._end or {"event": "error", "message": self._why_it_ended()}
            self._news.notify_all()
        _running.discard(self)

    def _keep_log(self) -> None:
        written = 0
        try:
            with open(self.log, "ab", buffering=0) as log:
                for line in _lines(self.process.stderr):
                    self._tail = (self._tail + line)[-LONGEST_LINE:]
                    if written <= MOST_LOG_BYTES:
                        with contextlib.suppress(OSError):  # the disk may be full; the tail is in memory
                            log.write(line)
                        written += len(line)
        except OSError:
            for line in _lines(self.process.stderr):
                self._tail = (self._tail + line)[-LONGEST_LINE:]

    def poll(self, timeout: float | None = None) -> list[dict]:
        """What is new since the last call: the last progress, and the end ("done" or "error") once; waits up to
        `timeout` seconds for the first news. A process that leaves without an end gives an "error" with the last
        line of its log."""
        with self._news:
            if timeout:
                self._news.wait_for(lambda: self._progress or (self._end and not self._end_reported), timeout)
            news = [self._progress] if self._progress else []
            if self._end and not self._end_reported:
                news.append(self._end)
                self._end_reported = True
            self._progress = None
        return news

    def log_text(self) -> str:
        """The log: its beginning from the file and, where more was said than that keeps, its end."""
        try:
            head = self.log.read_bytes()
        except OSError:
            head = b""
        tail = self._tail
        whole = head if head.endswith(tail) else head + b"\n[...]\n" + tail
        return whole.decode("utf-8", "replace")

    def _why_it_ended(self) -> str:
        code = self.process.returncode
        said = [x.strip() for x in self._tail.decode("utf-8", "replace").splitlines() if x.strip()]
        name = hex(code) if code >= 0xC0000000 else code  # as Windows' own are known
        how = f"was ended by signal {-code}" if code < 0 else f"ended with code {name}"
        return f"The process {how}: {said[-1][:300] if said else 'it said nothing'}"

    def kill(self) -> None:
        """Ends the process and its children, now. Harmless when it has ended."""
        _running.discard(self)
        self._end_group()
        self.process.wait()
        with contextlib.suppress(OSError):
            self.process.stdin.close()
        self._logger.join(2.0)  # Windows removes no folder while a file in it is open

    def _end_group(self) -> None:
        if not WINDOWS:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(self.process.pid, signal.SIGKILL)  # what it started goes too, even after its own end
        elif self.process.poll() is None:
            command = ["taskkill", "/F", "/T", "/PID", str(self.process.pid)]
            with contextlib.suppress(OSError):  # not to be found, say
                subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, creationflags=NO_WINDOW)
            self.process.kill()


def _lines(pipe):
    """Lines of a pipe, cut where they are longer than LONGEST_LINE; with naps where they come too fast."""
    count = 0
    while line := pipe.readline(LONGEST_LINE):
        yield line
        count += len(line)
        if count > BYTES_UNTIL_NAP:
            count = 0
            time.sleep(NAP_SECONDS)


def _parse_event(line: bytes) -> dict | None:
    """An event as the protocol has it, its fraction within 0..1 and its texts short; None for anything else."""
    if not line.startswith(b"{"):
        return None
    try:
        event = json.loads(line)
        kind = event["event"]
        if kind == "progress":
            fraction = float(event.get("fraction", 0))
            event["fraction"] = min(max(fraction, 0.0), 1.0) if math.isfinite(fraction) else 0.0
            event["text"] = str(event.get("text", ""))[:200]
        if kind == "error":
            event["message"] = str(event.get("message", "it does not say why"))[:2000]
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
    return event if kind in ("progress", "done", "error") else None


def kill_all() -> None:
    for child in list(_running):
        child.kill()


atexit.register(kill_all)
