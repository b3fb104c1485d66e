# SPDX-License-Identifier: GPL-3.0-or-later
"""What every command line of Timesplat's does where it cannot go on: a sentence, and an exit code."""

from __future__ import annotations

import sys
from collections.abc import Callable

from .datagen.sequence import InputError

BAD_INPUT, STOPPED, NOBODY_READS = 2, 130, 141  # as shells have it: 128 + SIGINT, 128 + SIGPIPE
# The extra of pyproject.toml that brings a package.
EXTRAS = {"bpy": "render", "OpenEXR": "render", "torch": "torch", "numba": "torch", "safetensors": "torch"}
EXTRAS |= {"pxr": "usd", "matplotlib": "figures", "av": "video", "fourdgs": "fourdgs", "ray": "ray"}


def exit_code(program: str, call: Callable[[], int | None]) -> int:
    """What `call` returns, None as 0; BAD_INPUT after a sentence on standard error for an InputError and for a package
    that is not installed, STOPPED after Ctrl-C."""
    try:
        return call() or 0
    except InputError as e:
        print(f"{program}: {e}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print(f"{program}: stopped; what was complete is kept, and the same command goes on.", file=sys.stderr)
        return STOPPED
    except ModuleNotFoundError as e:
        name = (e.name or "").split(".")[0]
        if name not in EXTRAS:
            raise
        print(f"{program}: {name} is not installed; pip install 'timesplat[{EXTRAS[name]}]'.", file=sys.stderr)
        return BAD_INPUT
