# SPDX-License-Identifier: GPL-3.0-or-later
"""One asset in a process of its own: `python -m timesplat.datagen.render_asset JOB.json LOG`, by `render_child`.

The job names the asset, the settings, and where to write; messages go to stdout as JSON lines ({"image": n,
"of": total}, {"written": folder}, {"warning": …}, {"error": …, "status": …}), all that Blender prints goes to the log.
What needs Blender is imported late: it starts its threads, and prints, only after `main` has made ready for that.
"""

from __future__ import annotations

import ctypes
import json
import math
import os
import re
import signal
import sys
import zlib
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

from .render_index import CRASHED, MEMORY, REFUSED
from .render_job import (
    ALL_CLIPS,
    CONSECUTIVE,
    FIRST_CLIP,
    MOST_MOVING_CLIP,
    SINGLE,
    Asset,
    RenderSettings,
    rendered_clips,
    zoo_seed,
)
from .rigs import RIGS, targets
from .sequence import InputError, Normalisation, distinct


def run_job(job: dict, send: Callable[[dict], None]) -> None:
    """Opens the asset and renders each of its clips that the settings choose. `job`: "asset" (Asset as a dict),
    "settings" (RenderSettings as a dict), "terms" (entries of the provenance), and "out" (a folder for a folder a clip)
    or "folder" (that of the one clip). Raises InputError."""
    settings, asset = RenderSettings(**job["settings"]), Asset(**job["asset"])
    from .capture import clocks

    start = (clocks()[0], 0.0)  # the start of Python and of Blender is of the first clip's processor seconds
    opened, provenance = _open(asset)
    provenance |= job["terms"]
    for warning in opened.warnings:
        send({"warning": warning})
    if settings.device == "GPU":
        use_gpu()
    clips = cut_clips(choose_clips(opened, settings), settings, asset.path)
    provenance |= {"settings": asdict(settings), "clips": len(clips), "warnings": opened.warnings}
    simulated = False
    for name, clip in _folder_names(clips).items():
        folder = Path(job["folder"]) if "folder" in job else Path(job["out"]) / name
        if not rendered_clips(folder, asset, settings):  # else it is of a run that was cut off
            opened.play(clip)
            if not clip.actions and not simulated:
                simulate_scene([c for c in clips if not c.actions], settings)
                simulated = True
            _render_clip(clip, asset, folder, settings, provenance, start, send)
            start = clocks()
        send({"written": str(folder)})


def _open(asset: Asset):
    """The OpenedAsset, and the beginning of its Sequences' provenance."""
    from .scene.clips import Clip
    from .scene.open import OpenedAsset, empty_session, open_asset, tool_versions

    provenance: dict = {"asset": Path(asset.path).name, **tool_versions()}
    if seed := zoo_seed(asset.path):
        from .zoo.build import build_object
        from .zoo.puppet import FRAMES

        empty_session()
        provenance["zoo"] = build_object(int(seed))
        return OpenedAsset(Path(asset.path), "", [Clip("zoo", 1, FRAMES)]), provenance
    opened = open_asset(Path(asset.path), Path(asset.root) if asset.root else None)
    provenance |= {"path": asset.below_root, "sha256": opened.sha256}
    return opened, provenance


def _render_clip(
    clip,
    asset: Asset,
    folder: Path,
    settings: RenderSettings,
    provenance: dict,
    started: tuple[float, float],
    send: Callable[[dict], None],
) -> None:
    """Renders the clip that the open scene plays into the Sequence `folder`. started: as `capture` takes it."""
    from .scene.clips import changes_looks
    from .scene.measure import holds_still, normalisation
    from .scene.rescale import LARGEST, SMALLEST, rescaled

    frames = scene_frames(clip, settings)
    if settings.displace:
        frames = frames[:1] * settings.frames
    warnings = list(provenance["warnings"])
    if clip.frame_end > clip.frame_start and not settings.displace and not changes_looks(clip) and holds_still(frames):
        span = f"{frames[0]:g} to {frames[-1]:g}"
        warnings.append(f"{asset.path}: nothing moves in frames {span} of the clip {clip.name}; choose another.")
        send({"warning": warnings[-1]})
    # every clip of every object gets cameras of its own
    seed = zlib.crc32(f"{settings.seed}/{asset.name}/{clip.name}".encode())
    provenance = provenance | {"warnings": warnings, "clip": clip.name, "scene_frames": frames, "cameras_seed": seed}
    norm, aabb = normalisation(frames, name=asset.path)
    if SMALLEST <= norm.scale <= LARGEST:
        _capture(asset.path, frames, norm, aabb, 1.0, seed, folder, settings, provenance, started, send)
        return
    unit = 1 / norm.scale
    with rescaled(unit):
        norm, aabb = normalisation(frames, name=asset.path)
        if not SMALLEST <= norm.scale <= LARGEST:
            raise InputError(f"{asset.path}: it is too small or too large to be rendered; scale it by {unit:.0e}.")
        _capture(asset.path, frames, norm, aabb, unit, seed, folder, settings, provenance, started, send)


def _capture(
    name: str,
    frames: list,
    norm: Normalisation,
    aabb,
    unit: float,
    seed: int,
    folder: Path,
    settings: RenderSettings,
    provenance: dict,
    started: tuple[float, float],
    send: Callable[[dict], None],
) -> None:
    """Renders these frames of the open scene, which is `unit` times as large as the asset `name`."""
    from .capture import Subject, capture
    from .displace import displacements
    from .render_setup import CaptureSettings

    shift = None
    if settings.displace:
        norm, aabb, shift = displacements(norm, aabb, len(frames), seed)
    numbers = list(range(len(frames)))
    sent = 0

    def progress(done: int, total: int) -> None:
        nonlocal sent
        send({"image": done - sent, "of": total})
        sent = done

    capture(
        RIGS[settings.rig](numbers, seed) + targets(numbers, seed, settings.targets),
        folder,
        Subject(frames, norm, aabb, shift=shift, unit=unit),
        CaptureSettings(
            size=settings.size,
            samples=settings.samples,
            passes=settings.passes,
            linear=settings.linear,
            tracks=settings.track_count,
            device=settings.device,
            seed=seed % 2**20,
        ),
        provenance=provenance,
        started=started,
        refuse_empty=name,
        progress=progress,
    )


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


def choose_clips(opened, settings: RenderSettings) -> list:
    """The clips that `settings.clip` asks for. InputError naming those that exist if there is none such."""
    if settings.clip == ALL_CLIPS:
        return opened.clips
    if settings.clip == FIRST_CLIP:
        return opened.clips[:1]
    if settings.clip == MOST_MOVING_CLIP:
        return [most_moving_clip(opened, settings)]
    chosen = [c for c in opened.clips if c.name == settings.clip]
    if not chosen:
        names = ", ".join(c.name for c in opened.clips)
        raise InputError(f"{opened.path}: it has no clip named {settings.clip}; it has {names}.")
    return chosen[:1]


def most_moving_clip(opened, settings: RenderSettings | None = None):
    """The clip in whose frames, those that the settings choose, the vertices move most, judged by six of them."""
    from .scene.measure import motion

    if len(opened.clips) == 1:
        return opened.clips[0]
    settings = settings or RenderSettings()
    whole = replace(settings, clips=SINGLE, every=1, spread=True) if settings.clips == CONSECUTIVE else settings

    def amount(clip) -> float:
        opened.play(clip)
        frames = scene_frames(clip, whole)
        return motion([frames[round(i * (len(frames) - 1) / 5)] for i in range(6)]) if frames else -1.0

    return max(opened.clips, key=amount)


def scene_frames(clip, settings: RenderSettings) -> list[float]:
    """The scene frames of a clip that the settings choose; none where it ends before `settings.start`."""
    start = 0 if settings.clips == CONSECUTIVE else settings.start  # `cut_clips` has passed it over
    return clip.frames(settings.frames, start=start, every=settings.every, spread=settings.spread)


def cut_clips(clips: list, settings: RenderSettings, name: str) -> list:
    """The clips, each cut into consecutive ones where the settings say so. InputError (with `name`) if none of them
    lasts until `settings.start`."""
    if settings.clips == CONSECUTIVE:
        found = [part for c in clips for part in c.cut(settings.frames, start=settings.start, every=settings.every)]
    else:
        found = [c for c in clips if scene_frames(c, settings)]
    if not found:
        longest = max(c.frame_end - c.frame_start + 1 for c in clips)
        raise InputError(
            f"{name}: it has {longest} frames, none from --start {settings.start} on; choose an earlier one."
        )
    return found


def simulate_scene(clips: list, settings: RenderSettings) -> None:
    """Plays what is simulated up to the last frame of these clips."""
    from .scene.simulate import simulate

    simulate(math.ceil(max(scene_frames(clip, settings)[-1] for clip in clips)))


def _folder_names(clips: list) -> dict:
    """Name of a folder -> clip."""
    plain = [re.sub(r"[^A-Za-z0-9]+", "-", clip.name).strip("-") or "clip" for clip in clips]
    return dict(zip(distinct(plain), clips, strict=True))


def die_with_parent() -> None:
    """Where the system can: when the run is killed, this process goes too, in the middle of what Blender does; else it
    would write where the run that is started again does. (Elsewhere it goes when it next has something to say.)"""
    if sys.platform == "linux":
        parent = os.getppid()
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
        if os.getppid() != parent:
            os._exit(1)


def main(job_file: str, log: str) -> int:
    """0 if all is written, 2 after an InputError, 1 after anything else; the reason has been sent."""
    job = json.loads(Path(job_file).read_text())
    out = os.fdopen(os.dup(1), "w", buffering=1)
    sink = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(sink, 1)
    os.dup2(sink, 2)
    die_with_parent()
    if job["cores"] and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, job["cores"])  # before Blender starts its threads

    def send(message: dict) -> None:
        print(json.dumps(message), file=out)

    try:
        run_job(job, send)
    except InputError as e:
        send({"error": str(e), "status": REFUSED})
        return 2
    except MemoryError:
        sentence = f"{job['asset']['path']}: the memory does not suffice; render it smaller or alone."
        send({"error": sentence, "status": MEMORY})
        return 1
    except Exception as e:
        sentence = f"{job['asset']['path']}: rendering failed ({type(e).__name__}: {e}); please report it."
        send({"error": sentence, "status": CRASHED})
        return 1
    return 0


if __name__ == "__main__":
    status = main(*sys.argv[1:])
    os._exit(status)  # Blender's own way out is slow, and can crash after all is written
