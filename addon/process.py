# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs `model.worker` under an interpreter that has torch, and reads its answers without ever waiting.

torch never comes into Blender's process: the two speak JSON lines through pipes. A thread reads, the caller
drains a queue. The process and its children die on `kill`, with the add-on, and with Blender itself (the
worker leaves when its standard input closes).
"""

from __future__ import annotations

import atexit
import contextlib
import importlib.util
import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from queue import Empty, SimpleQueue

from ..datagen.sequence import InputError

PACKAGE = Path(__file__).resolve().parent.parent
# Imports this folder as the package `timesplat`, whatever the folder is called, and runs its worker. (Its
# parent stays off the path: other extensions live there, with names that could hide real packages.)
LAUNCH = """
import importlib.util, runpy, sys
folder = sys.argv.pop(1)
spec = importlib.util.spec_from_file_location("timesplat", folder + "/__init__.py", submodule_search_locations=[folder])
package = sys.modules["timesplat"] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(package)
runpy.run_module("timesplat.model.worker", run_name="__main__", alter_sys=True)
"""
_running: set[Worker] = set()


def find_python(preferred: str = "") -> str:
    """The interpreter for the worker: `preferred`, else TIMESPLAT_PYTHON, else Blender's own if torch is
    installed there. Raises InputError where there is none."""
    for source, path in (
        ("the preference Python", preferred),
        ("TIMESPLAT_PYTHON", os.environ.get("TIMESPLAT_PYTHON")),
    ):
        if path:
            if not Path(path).is_file():
                raise InputError(f"{path}: no such file; correct {source}.")
            return path
    if importlib.util.find_spec("torch"):  # looks, does not import
        return sys.executable
    raise InputError(
        "No Python with torch is known: install timesplat[torch] somewhere and name that Python in the add-on's "
        "preferences or in TIMESPLAT_PYTHON."
    )


class Worker:
    """One request to `model.worker`, started at once. `folder`: an existing folder for its log."""

    def __init__(self, python: str, request: dict, folder: Path) -> None:
        self.log = Path(folder) / "worker.log"
        self._events: SimpleQueue[dict | None] = SimpleQueue()
        self._ended = False
        env = {k: v for k, v in os.environ.items() if k != "PYTHONHOME"} | {"PYTHONUNBUFFERED": "1"}
        group = {"start_new_session": True} if os.name == "posix" else {"creationflags": 0x00000200 | 0x08000000}
        try:
            with open(self.log, "wb") as log:
                self.process = subprocess.Popen(
                    [python, "-c", LAUNCH, str(PACKAGE)],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=log,
                    cwd=folder,
                    env=env,
                    **group,
                )
        except OSError as e:
            raise InputError(f"{python}: it cannot be started ({e.strerror or e}); choose another Python.") from None
        _running.add(self)
        with contextlib.suppress(OSError):  # it may be gone already; then the log says why
            self.process.stdin.write((json.dumps({**request, "watch": True}) + "\n").encode())
            self.process.stdin.flush()  # and it stays open: its end is the sign that Blender is gone
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for line in self.process.stdout:
            try:
                event = json.loads(line)
            except ValueError:
                continue
            if isinstance(event, dict) and "event" in event:
                self._events.put(event)
        self.process.wait()
        self._events.put(None)

    def poll(self, timeout: float | None = None) -> list[dict]:
        """The events since the last call, waiting up to `timeout` seconds for the first. A process that ends
        without "done" or "error" gives an "error" with the last line of its log."""
        events: list[dict] = []
        with contextlib.suppress(Empty):
            while not self._ended:
                event = self._events.get(block=timeout is not None and not events, timeout=timeout)
                if event is None:
                    _running.discard(self)
                    event = {"event": "error", "message": self._last_words()}
                self._ended = event["event"] in ("done", "error")
                events.append(event)
        return events

    def _last_words(self) -> str:
        lines = self.log.read_text(errors="replace").strip().splitlines() if self.log.is_file() else []
        said = lines[-1].strip()[:300] if lines else "it said nothing"
        return f"The worker process ended with code {self.process.returncode}: {said}"

    def kill(self) -> None:
        """Ends the process and its children, now. Harmless when it has ended."""
        _running.discard(self)
        if self.process.poll() is None:
            if os.name == "posix":
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(self.process.pid, signal.SIGKILL)
            else:
                subprocess.run(["taskkill", "/F", "/T", "/PID", str(self.process.pid)], capture_output=True)
        self.process.wait()
        with contextlib.suppress(OSError):
            self.process.stdin.close()


def kill_all() -> None:
    for worker in list(_running):
        worker.kill()


atexit.register(kill_all)
