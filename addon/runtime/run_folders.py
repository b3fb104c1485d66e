# SPDX-License-Identifier: GPL-3.0-or-later
"""The folders that Jobs work in: one a Job, named after the Blender that runs it, removed when the Job has ended."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
import time
from pathlib import Path

from ...datagen.whole_folders import WINDOWS
from .folders import user_folder

MOST_OF_A_CRASH = 20_000  # characters: the end, where the call stack is


def make() -> Path:
    """A new, empty folder of this Blender's. Raises OSError."""
    return Path(tempfile.mkdtemp(prefix=f"run-{os.getpid()}-", dir=user_folder("runs")))


def crash_logs(folder: Path) -> str:
    """What Blenders that crashed in the folder left there, which is their folder for temporary files."""
    texts = []
    for path in sorted(folder.glob("**/*.crash.txt")):
        with contextlib.suppress(OSError):
            texts.append(f"\n{path.name}\n{path.read_text(encoding='utf-8', errors='replace')[-MOST_OF_A_CRASH:]}\n")
    return "".join(texts)


def remove(folder: Path) -> None:
    """Removes a folder with all that is in it, within half a second; harmless where it is gone."""
    for _ in range(10):
        shutil.rmtree(folder, ignore_errors=True)
        if not folder.exists():
            break
        time.sleep(0.05)  # what was killed may be in the middle of its last write


def sweep(in_use: list[Path]) -> None:
    """Removes what Blenders that are gone left, and all of this one's but what is in use: what ended Jobs could not
    remove because something still held it."""
    for folder in user_folder("runs").glob("run-*-*"):
        with contextlib.suppress(ValueError):
            pid = int(folder.name.split("-")[1])
            if not (folder in in_use if pid == os.getpid() else _is_alive(pid)):
                shutil.rmtree(folder, ignore_errors=True)


def _is_alive(pid: int) -> bool:
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
