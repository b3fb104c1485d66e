# SPDX-License-Identifier: GPL-3.0-or-later
"""One asset in a process of its own: `python -m timesplat.datagen.render_asset JOB.json LOG`, started by `render`.

The job names the asset, the settings, and where to write; messages go to stdout as JSON lines ({"image": n,
"of": total}, {"written": folder}, {"warning": …}, {"error": …}), all that Blender prints goes to the log.
"""

from __future__ import annotations

import json
import os
import re
import sys
import zlib
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

from .farm import ALL, FIRST, MOST, Settings, is_made, stem, zoo_seed
from .rigs import RIGS, targets
from .sequence import InputError, distinct


def run_job(job: dict, say: Callable[[dict], None]) -> None:
    """Opens the asset and renders each of its clips that the settings choose."""
    from . import capture, displace, scene
    from .clips import Clip

    settings, asset = Settings(**job["settings"]), job["asset"]
    provenance: dict = {"asset": Path(asset).name, **scene.versions()}
    if seed := zoo_seed(asset):
        from .zoo import build as zoo

        scene.empty()
        provenance["zoo"] = zoo.build(int(seed))
        opened = scene.Asset(Path(asset), "", [Clip("zoo", 1, 24)])
    else:
        opened = scene.open_asset(Path(asset))
        provenance["sha256"] = opened.sha256
    for warning in opened.warnings:
        say({"warning": warning})
    if settings.device == "GPU":
        use_gpu()
    clips = choose(opened, settings)
    provenance |= {"settings": asdict(settings), "clips": len(clips), "warnings": opened.warnings}
    for slug, clip in _slugs(clips).items():
        folder = Path(job["folder"]) if "folder" in job else Path(job["out"]) / slug
        if is_made(folder, asset, settings):  # by a run that was cut off
            say({"written": str(folder)})
            continue
        opened.play(clip)
        frames = clip.frames(settings.frames)
        if settings.displace:
            frames = frames[:1] * settings.frames
        if not clip.actions:
            scene.simulate(frames[-1])
        norm, aabb = scene.normalisation(frames, name=asset)
        # every clip of every object gets cameras of its own
        seed = zlib.crc32(f"{settings.seed}/{stem(asset)}/{clip.name}".encode())
        shift = None
        if settings.displace:
            norm, aabb, shift = displace.displacements(norm, aabb, len(frames), seed)
        numbers = list(range(len(frames)))
        shots = RIGS[settings.rig](numbers, seed) + targets(numbers, seed, settings.targets)
        before = 0

        def progress(done: int, total: int) -> None:
            nonlocal before
            say({"image": done - before, "of": total})
            before = done

        capture.capture(
            shots,
            folder,
            frames=frames,
            normalisation=norm,
            aabb=aabb,
            size=settings.size,
            samples=settings.samples,
            passes=settings.passes,
            linear=settings.linear,
            device=settings.device,
            seed=seed % 2**20,
            shift=shift,
            provenance=provenance | {"clip": clip.name, "scene_frames": frames, "cameras_seed": seed},
            progress=progress,
        )
        say({"written": str(folder)})


def use_gpu() -> None:
    """Turns on the graphics cards that Cycles finds; the session's preferences are the factory's."""
    import bpy

    preferences = bpy.context.preferences.addons["cycles"].preferences
    for kind in ("OPTIX", "CUDA", "HIP", "METAL", "ONEAPI"):
        try:
            devices = [d for d in preferences.get_devices_for_type(kind) if d.type == kind]
        except (ValueError, TypeError):  # not known to this build
            continue
        if devices:
            preferences.compute_device_type = kind
            for device in devices:
                device.use = True
            return
    raise InputError("--device GPU: Cycles finds no graphics card here; render with --device CPU.")


def choose(opened, settings: Settings) -> list:
    """The clips that `settings.clip` asks for. InputError naming those that exist if there is none such."""
    from . import scene

    if settings.clip == ALL:
        return opened.clips
    if settings.clip == FIRST:
        return opened.clips[:1]
    if settings.clip == MOST:
        return [scene.most_moving(opened, settings.frames)]
    chosen = [c for c in opened.clips if c.name == settings.clip]
    if not chosen:
        names = ", ".join(c.name for c in opened.clips)
        raise InputError(f"{opened.path}: it has no clip named {settings.clip}; it has {names}.")
    return chosen[:1]


def _slugs(clips: list) -> dict:
    """File name -> clip."""
    plain = [re.sub(r"[^A-Za-z0-9]+", "-", clip.name).strip("-") or "clip" for clip in clips]
    return dict(zip(distinct(plain), clips, strict=True))


def main(job_file: str, log: str) -> int:
    """0 if all is written, 2 after an InputError, 1 after anything else; the reason has been said."""
    job = json.loads(Path(job_file).read_text())
    out = os.fdopen(os.dup(1), "w", buffering=1)
    sink = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(sink, 1)
    os.dup2(sink, 2)
    if job["cores"] and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, job["cores"])  # before Blender starts its threads
    say = lambda message: print(json.dumps(message), file=out)  # noqa: E731
    try:
        run_job(job, say)
    except InputError as e:
        say({"error": str(e)})
        return 2
    except MemoryError:
        say({"error": f"{job['asset']}: the memory does not suffice; render it smaller or alone."})
        return 1
    except Exception as e:
        say({"error": f"{job['asset']}: rendering failed ({type(e).__name__}: {e}); please report it."})
        return 1
    return 0


if __name__ == "__main__":
    status = main(*sys.argv[1:])
    os._exit(status)  # Blender's own way out is slow, and can crash after all is written
