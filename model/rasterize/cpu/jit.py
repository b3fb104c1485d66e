# SPDX-License-Identifier: GPL-3.0-or-later
"""How the CPU backend's functions are compiled, and when again."""

from __future__ import annotations

import hashlib
from pathlib import Path

from numba import njit

_FOLDER = Path(__file__).parent
_SOURCES = [_FOLDER.parent / "constants.py", *sorted(_FOLDER.glob("*.py"))]
_DIGEST = hashlib.sha256(b"".join(file.read_bytes() for file in _SOURCES)).hexdigest()[:16]


def jit(function):
    """Compiles with numba, without the GIL. Numba's cache goes by a function's file alone, but constants and functions
    of one file are compiled into those of others: so the contents of all are in the name under which it is cached."""
    function.__qualname__ += f"_{_DIGEST}"
    return njit(cache=True, nogil=True, error_model="numpy")(function)
