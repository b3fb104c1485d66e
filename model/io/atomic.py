# SPDX-License-Identifier: GPL-3.0-or-later
"""Writing a file whole or not at all."""

from __future__ import annotations

import os
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
