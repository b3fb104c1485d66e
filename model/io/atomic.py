# SPDX-License-Identifier: GPL-3.0-or-later
"""Writing a file or a folder whole or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ...datagen.sequence import InputError
from ...datagen.whole_folders import WINDOWS, move


@contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Yields a name beside `path` (same suffix) to write to; it is moved to `path` on success, removed on
    any error. The folder is made. An OSError becomes an InputError that names the path."""
    path = Path(path)
    tmp = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield tmp
        move(tmp, path)
    except OSError as e:
        todo = "choose another place"
        if WINDOWS and isinstance(e, PermissionError) and path.is_file():
            todo = f"close the program that has it open, or {todo}"
        raise InputError(f"{path}: it cannot be written ({e.strerror or e}); {todo}.") from None
    finally:
        with suppress(OSError):  # where the folder is a file, say
            tmp.unlink(missing_ok=True)


@contextmanager
def new_folder(path: str | Path) -> Iterator[Path]:
    """Yields an empty folder to write to, which becomes `path` on success and is removed on any error. Raises
    InputError, also for an OSError and if the folder exists and is not empty."""
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists() and (not path.is_dir() or any(path.iterdir())):
            raise InputError(f"{path}: it exists already and is not an empty folder; choose another name.")
        with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as tmp:
            whole = Path(tmp) / "whole"
            whole.mkdir()
            yield whole
            if path.is_dir():
                path.rmdir()
            shutil.move(whole, path)
    except OSError as e:
        raise InputError(f"{path}: it cannot be written ({e.strerror or e}); choose another place.") from None
