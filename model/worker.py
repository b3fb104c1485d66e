# SPDX-License-Identifier: GPL-3.0-or-later
"""The process that the add-on talks to: `python -m timesplat.model.worker [request.json]`.

It reads one JSON object, from the file named or else from the first line of standard input. Its "task" says what
to do; null or "" is the same as leaving a key out:
    reconstruct (default)
        sequence    folder of a Sequence            asset       .ply to write
        method      tracks | lift | guided | …      device      "cpu" (default), "cuda", …
        checkpoint  weights to use                  indices     views to use (default: all)
        quality     draft | balanced | fine | best, how much is fitted; or in its place
        refine      seconds of fitting (0) …        budget      "N", "P%" or "auto"
        max_loss    dB that "auto" may lose (0.1)   … which for tracks are all that there are
        done: asset, gaussians, method, note (what the artist should know; a sentence or nothing)
    export          what Blender lacks libraries for (never imports torch)
        asset       .ply to read                    out         .usd*, .4dgs, or .sog of a frame, to write
        frame       of a .sog
        mode        splats | points | frames        half        true or false
        original    .usd* of the object, for a variant beside the reconstruction
        motion      .npy with where the asset is taken at each frame (see write_usd)
        suffix      with folders for asset and out: each slice of the one as this kind into the other
        done: out, complaints (the validator's, a list of sentences), bytes
    import          the other way round             (never imports torch)
        source      .usd*, .4dgs or .sog to read    asset       .ply to write
        sources     the files of a sequence, of which source is one, with fps and frame_start
        motion      .npy to write where the asset moves as a whole (see load_usd)
        done: asset, gaussians, up, note
    video           a film (see film.py)
        asset       .ply to read                    out         .mp4, .webp or a new folder to write
        cameras     .json of film_command.read_cameras, in place of a turntable that plays `plays` times
        size        [width, height]                 fps         pictures a second (the clip's)
        background  as rrggbb, or none (white)
        done: out, pictures
    selftest        does this interpreter reconstruct?
        device, checkpoint
        done: report (a list of lines)
and with any task
    watch       true: stop when standard input closes, that is when the program that asked is gone
It answers with one JSON object a line on standard output:
    {"event": "progress", "fraction": 0..1, "text": …}
    {"event": "done", …, "seconds": s}                                    exit code 0
    {"event": "error", "message": one sentence}                           exit code 1
Whatever a library prints goes to standard error, so that the answers stay whole.
"""

from __future__ import annotations

import json
import math
import os
import sys
import threading
import time
import traceback
from pathlib import Path
from types import ModuleType
from typing import TextIO

import numpy as np

from ..datagen.readers import open_sequence
from ..datagen.sequence import InputError

_KINDS = {"text": str, "number": (int, float), "true or false": bool, "list": list}
_KEYS = {
    "task": "text", "watch": "true or false", "sequence": "text", "asset": "text", "method": "text",
    "device": "text", "checkpoint": "text", "indices": "list", "refine": "number", "budget": "text",
    "max_loss": "number", "out": "text", "mode": "text", "half": "true or false", "source": "text",
    "original": "text", "motion": "text", "quality": "text", "frame": "number", "suffix": "text", "sources": "list",
    "fps": "number", "frame_start": "number", "cameras": "text", "size": "list", "plays": "number",
    "background": "text",
}  # fmt: skip
_NEEDED = {"reconstruct": ("sequence", "asset"), "export": ("asset", "out"), "import": ("source", "asset")}
_NEEDED |= {"video": ("asset", "out"), "selftest": ()}


def main(argv: list[str]) -> int:
    """Answers one request (see the module); returns the exit code."""
    answers = _take_stdout()

    def say(event: str, **values) -> None:
        print(json.dumps({"event": event, **values}), file=answers, flush=True)

    def progress(fraction: float, text: str) -> None:
        say("progress", fraction=round(float(fraction), 4), text=str(text))

    start, task = time.monotonic(), "request"
    try:
        request = _request(argv)
        task = request.setdefault("task", "reconstruct")
        if request.get("watch"):
            threading.Thread(target=_leave_when_closed, args=[_take_stdin()], daemon=True).start()
        do = {
            "reconstruct": _reconstruct,
            "export": _export,
            "import": _import,
            "video": _video,
            "selftest": _selftest,
        }[task]
        say("done", **do(request, progress), seconds=round(time.monotonic() - start, 3))
    except InputError as e:
        say("error", message=str(e))
        return 1
    except ImportError as e:
        say("error", message=f"{sys.executable} lacks {e.name or e}; install timesplat[torch] there.")
        return 1
    except Exception as e:
        traceback.print_exc()
        why = " ".join(str(e).split())[:300]
        name = {"reconstruct": "reconstruction", "selftest": "self-test"}.get(task, task)
        say("error", message=f"The {name} stopped with {type(e).__name__}: {why}")
        return 1
    return 0


def _reconstruct(request: dict, progress) -> dict:
    progress(0.0, "starting")
    sequence = open_sequence(Path(request["sequence"]))
    views, indices = len(sequence.views), request.get("indices")
    for i in indices or []:
        if type(i) is not int or not 0 <= i < views:
            raise InputError(f"{sequence.root}: it has no view {i!r}; give numbers from 0 to {views - 1}.")
    max_loss = request.get("max_loss", 0.1)
    if not (math.isfinite(max_loss) and max_loss > 0):
        raise InputError(f"{max_loss:g} dB of loss: give more than 0.")
    from .io.ply import write_ply

    refine, budget, checkpoint = request.get("refine", 0.0), request.get("budget"), request.get("checkpoint")
    quality = request.get("quality")
    if not (refine or budget or quality) and request.get("method", "tracks") not in ("tracks", "deform"):
        # A third of torch's start-up: what shapes its operations return, for compilers. What fits uses
        # torch.optim, which loads them; so do tracks' random numbers.
        sys.modules.setdefault("torch._meta_registrations", ModuleType("torch._meta_registrations"))
    from .clip import clip_of
    from .methods import method_named
    from .reconstruct import ReconstructOptions, chosen_method, reconstruct, untracked_note  # imports torch

    method = chosen_method(sequence, request.get("method"), indices)
    if not (refine or quality):
        quality = method_named(method).quality
    options = ReconstructOptions(
        device=request.get("device", "cpu"),
        checkpoint=Path(checkpoint) if checkpoint else None,
        seconds=refine,
        refine=refine,
        quality=quality,
        budget=budget,
        max_loss=max_loss,
    )
    compiled = any(Path(__file__).parent.rglob("__pycache__/*.nbi"))  # numba's, of an earlier run
    note = "" if compiled else "; the first run compiles, which takes half a minute"
    gaussians = reconstruct(
        sequence,
        method,
        indices,
        options,
        progress=lambda fraction, text: progress(0.05 + 0.9 * fraction, text + note),
    )
    if len(gaussians) == 0:
        raise InputError(f"{sequence.root}: nothing was found to reconstruct; check that views show the object.")
    progress(0.95, "writing the asset")
    write_ply(request["asset"], gaussians.to_asset(clip_of(sequence)))
    note = untracked_note(sequence) if method_named(method).has_depth else ""
    return {"asset": request["asset"], "gaussians": len(gaussians), "method": method, "note": note}


def _export(request: dict, progress) -> dict:
    from .io.files import frame_files, read_asset, upright, write_asset
    from .io.ply import read_ply
    from .io.slices import write_moments
    from .io.usd_apart import limit_memory
    from .io.usd_check import check_usd
    from .io.usd_stage import USD_SUFFIXES

    limit_memory()
    out = Path(request["out"])
    if "suffix" in request:
        paths = frame_files(request["asset"])
        moments = ((int(p.stem.rsplit("_", 1)[1]), upright(read_asset(p))) for p in paths)
        count = write_moments(out, moments, out.name, cut=0, suffix=request["suffix"])
        return {"out": request["out"], "complaints": [], "files": count}
    progress(0.0, "reading the asset")
    asset = read_ply(request["asset"])
    progress(0.2, f"writing {out.name}")
    options: dict = {}
    usd = out.suffix.lower() in USD_SUFFIXES
    if usd:
        options = {k: request[k] for k in ("mode", "half", "original") if k in request}
        options |= {"motion": _matrices(request["motion"])} if "motion" in request else {}
    elif "frame" in request:
        options = {"frame": request["frame"], "cut": 0}
    write_asset(out, asset, **options)
    progress(0.7, f"checking {out.name}")
    return {"out": request["out"], "complaints": check_usd(out) if usd else [], "bytes": out.stat().st_size}


def _matrices(path: str) -> np.ndarray:
    try:
        return np.asarray(np.load(path, allow_pickle=False), float)
    except (OSError, ValueError, EOFError) as e:
        raise InputError(f"{path}: the motion cannot be read ({e}); export again.") from None


def _import(request: dict, progress) -> dict:
    from .io.files import read_frames
    from .io.ply import write_ply
    from .io.usd_apart import limit_memory
    from .io.usd_read import load_usd
    from .io.usd_stage import USD_SUFFIXES

    limit_memory()
    source = Path(request["source"])
    progress(0.0, f"reading {source.name}")
    if source.suffix.lower() in USD_SUFFIXES:
        loaded = load_usd(source)
    else:
        fps, start = request.get("fps", 24.0), int(request.get("frame_start", 1))
        loaded = read_frames(request.get("sources") or [source], fps=fps, frame_start=start)
    progress(0.7, "writing the asset")
    write_ply(request["asset"], loaded.asset)
    if loaded.motion is not None and "motion" in request:
        np.save(request["motion"], loaded.motion)
    told = {"up": loaded.up, "note": loaded.note}
    return {"asset": request["asset"], "gaussians": len(loaded.asset), **told}


def _video(request: dict, progress) -> dict:
    from .film import Look, check_look, placed, turntable, write_film
    from .film_command import background, read_cameras
    from .io.ply import read_ply

    progress(0.0, "reading the asset")
    out, asset = Path(request["out"]), read_ply(request["asset"])
    width, height = map(int, request.get("size", (512, 512)))
    look = Look(width, height, request.get("fps", asset.clip.fps), background(request.get("background"), out))
    check_look(out, look)
    if "cameras" in request:
        shots = placed(read_cameras(Path(request["cameras"])), asset)
    else:
        shots = turntable(asset, look.fps, int(request.get("plays", 0)) or None)
    return {"out": request["out"], "pictures": write_film(out, asset, shots, look, progress)}


def _selftest(request: dict, progress) -> dict:
    from .selftest import selftest

    checkpoint = request.get("checkpoint")
    report = selftest(request.get("device", "cpu"), Path(checkpoint) if checkpoint else None, progress)
    return {"report": report}


def _request(argv: list[str]) -> dict:
    """The request without keys that are null or empty; raises InputError."""
    source = argv[0] if argv else "standard input"
    try:
        text = Path(argv[0]).read_text(encoding="utf-8") if argv else sys.stdin.readline()
        request = json.loads(text)
        if not isinstance(request, dict):
            raise ValueError("it is not an object")
    except (OSError, ValueError) as e:
        raise InputError(f"{source}: the request cannot be read ({e}); give one JSON object.") from None
    request = {key: value for key, value in request.items() if value not in (None, "")}
    for key, value in request.items():
        if key not in _KEYS:
            raise InputError(f"{source}: unknown key {key}; known are {', '.join(_KEYS)}.")
        kind = _KEYS[key]
        if not isinstance(value, _KINDS[kind]) or (kind == "number" and isinstance(value, bool)):
            raise InputError(f"{source}: {key} must be a {kind}; correct it.".replace("a true", "true"))
    task = request.get("task", "reconstruct")
    if task not in _NEEDED:
        raise InputError(f"{source}: no task {task}; choose one of {', '.join(_NEEDED)}.")
    for key in _NEEDED[task]:
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


def _take_stdin() -> int:
    """A descriptor of our own of standard input, in whose place there is nothing to read from now on. On Windows a
    program hangs at its start if it inherits a pipe that is being read (cpython #78961)."""
    ours, nothing = os.dup(0), os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.close(nothing)
    return ours


def _leave_when_closed(pipe: int) -> None:
    while os.read(pipe, 1 << 16):
        pass
    os._exit(3)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
