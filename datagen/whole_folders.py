# SPDX-License-Identifier: GPL-3.0-or-later
"""Files and folders that appear whole or not at all."""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

from .errors import InputError

WINDOWS = os.name == "nt"
_PAUSES_BEFORE_RETRY = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6)  # seconds, see `move`


def move(source: str | Path, target: str | Path) -> None:
    """os.replace, within a disk. On Windows nothing can be moved while a program has it open, and a virus scanner opens
    what is new for a moment: there it is tried again for some seconds. Raises OSError."""
    for pause in _PAUSES_BEFORE_RETRY if WINDOWS else ():
        with contextlib.suppress(PermissionError):
            return os.replace(source, target)
        time.sleep(pause)
    os.replace(source, target)


def write_whole(path: Path, data: bytes) -> Path:
    """Writes a file whole or leaves it as it was, and makes its folder; returns the path. Raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    tmp = path.with_name(f".{path.name}.tmp")  # always the same one, so that a run that was killed leaves none for good
    tmp.write_bytes(data)
    move(tmp, path)
    return path


@contextlib.contextmanager
def whole_folder(folder: Path, mark: str, what: str) -> Iterator[Path]:
    """A temporary folder beside `folder`, which becomes it when the block ends. What was there is replaced if it holds
    the file `mark`, by which `what` is known, or nothing (else InputError). On any error nothing stays behind."""
    if folder.exists() and not (folder / mark).is_file() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: it exists and is not {what}; it is not overwritten, give another name.")
    folder.parent.mkdir(parents=True, exist_ok=True)
    # Not by `tempfile`, whose folders belong to this user alone, on Windows for good.
    tmp = folder.with_name(f".{folder.name}.{os.getpid()}-{secrets.token_hex(4)}")
    tmp.mkdir()
    old = tmp.with_name(f"{tmp.name}.old")
    try:
        yield tmp
        if folder.exists():
            move(folder, old)
        try:
            move(tmp, folder)
        except BaseException:
            if old.exists():
                move(old, folder)
            raise
    except BaseException:
        shutil.rmtree(tmp, ignore_errors=True)
        raise
    shutil.rmtree(old, ignore_errors=True)
