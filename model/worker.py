# SPDX-License-Identifier: GPL-3.0-or-later
"""The process that the add-on talks to: `python -m timesplat.model.worker [request.json]`.

It reads one JSON object, from the file named or else from the first line of standard input:
    sequence    folder of a Sequence            asset       .ply to write
    method      lift | guided | rgb | …         device      "cpu" (default), "cuda", …
    checkpoint  weights to use, or null         indices     views to use, or null for all
    watch       true: stop when standard input closes, that is when the program that asked is gone
and answers with one JSON object a line on standard output:
    {"event": "progress", "fraction": 0..1, "text": …}
    {"event": "done", "asset": path, "gaussians": N, "seconds": s}        exit code 0
    {"event": "error", "message": one sentence}                           exit code 1
Whatever a library prints goes to standard error, so that the answers stay whole.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
import traceback
from pathlib import Path
from types import ModuleType
from typing import TextIO

from ..datagen.sequence import InputError, read_sequence

_KEYS = {"sequence": str, "asset": str, "method": str, "device": str, "checkpoint": str, "indices": list, "watch": bool}


def main(argv: list[str]) -> int:
    """Answers one request (see the module); returns the exit code."""
    answers = _take_stdout()

    def say(event: str, **values) -> None:
        print(json.dumps({"event": event, **values}), file=answers, flush=True)

    start = time.monotonic()
    try:
        request = _request(argv)
        if request.get("watch"):
            threading.Thread(target=_leave_when_stdin_closes, daemon=True).start()
        count = _reconstruct(request, lambda f, text: say("progress", fraction=round(float(f), 4), text=str(text)))
        seconds = round(time.monotonic() - start, 3)
        say("done", asset=request["asset"], gaussians=count, seconds=seconds)
    except InputError as e:
        say("error", message=str(e))
        return 1
    except ImportError as e:
        say("error", message=f"{sys.executable} lacks {e.name or e}; install timesplat[torch] there.")
        return 1
    except Exception as e:
        traceback.print_exc()
        why = " ".join(str(e).split())[:300]
        say("error", message=f"The reconstruction stopped with {type(e).__name__}: {why}")
        return 1
    return 0


def _reconstruct(request: dict, progress) -> int:
    progress(0.0, "starting")
    sequence = read_sequence(Path(request["sequence"]))
    from .asset import write_ply

    # A third of torch's start-up: what shapes its operations return, for compilers, which are not used here.
    sys.modules.setdefault("torch._meta_registrations", ModuleType("torch._meta_registrations"))
    from .reconstruct import clip_of, reconstruct  # imports torch

    checkpoint = request.get("checkpoint")
    gaussians = reconstruct(
        sequence,
        request.get("method") or "guided",
        indices=request.get("indices"),
        device=request.get("device") or "cpu",
        checkpoint=Path(checkpoint) if checkpoint else None,
        progress=lambda fraction, text: progress(0.05 + 0.9 * fraction, text),
    )
    if len(gaussians) == 0:
        raise InputError(f"{sequence.root}: nothing was found to reconstruct; check that views show the object.")
    progress(0.95, "writing the asset")
    write_ply(request["asset"], gaussians.to_asset(clip_of(sequence)))
    return len(gaussians)


def _request(argv: list[str]) -> dict:
    source = argv[0] if argv else "standard input"
    try:
        text = Path(argv[0]).read_text() if argv else sys.stdin.readline()
        request = json.loads(text)
        if not isinstance(request, dict):
            raise ValueError("it is not an object")
    except (OSError, ValueError) as e:
        raise InputError(f"{source}: the request cannot be read ({e}); give one JSON object.") from None
    for key, value in request.items():
        if key not in _KEYS:
            raise InputError(f"{source}: unknown key {key}; known are {', '.join(_KEYS)}.")
        if value is not None and not isinstance(value, _KEYS[key]):
            raise InputError(f"{source}: {key} must be of type {_KEYS[key].__name__}; correct it.")
    for key in ("sequence", "asset"):
        if not request.get(key):
            raise InputError(f"{source}: {key} is missing; name a path.")
    return request


def _take_stdout() -> TextIO:
    """The real standard output as a file of our own; descriptor 1 leads to standard error from now on, for
    Python and for compiled libraries alike."""
    sys.stdout.flush()
    ours = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    sys.stdout = sys.stderr
    return ours


def _leave_when_stdin_closes() -> None:
    while sys.stdin.readline():
        pass
    os._exit(3)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
