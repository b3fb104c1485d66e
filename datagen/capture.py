# SPDX-License-Identifier: GPL-3.0-or-later
"""Renders chosen (camera, frame) pairs of the open Blender scene into a Sequence.

The command line and the add-on both come here. Nothing of the scene is moved, keyed or changed: the work is
done in a throw-away copy of it (`scene.borrow`), the cameras are placed in world space through the
normalisation, and depth is divided by its scale. All the cameras of a frame are one multi-view render, which
gives picture, depth and motion vectors at once.
"""

from __future__ import annotations

import os
import re
import struct
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import bpy
import numpy as np

from . import displace
from .blender_output import (
    fill_faint_surfaces,
    read_multilayer,
    shows_faint_surfaces,
    to_passes,
    to_straight_srgb,
)
from .image_files import write_png
from .passes import Passes, write_passes
from .render_setup import (
    CaptureSettings,
    MultiViewCameras,
    add_even_light,
    apply_settings,
    faint_surfaces_have_depth,
    temporary_data,
)
from .rigs import Shot
from .scene.borrow import borrowed
from .scene.steps import go_to, lengthen_frames
from .sequence import (
    InputError,
    Normalisation,
    Sequence,
    View,
    distinct,
    focal_from_fov,
    write_sequence,
)
from .track_file import write_tracks
from .tracks import track_surfaces


@dataclass(frozen=True)
class Subject:
    """What is captured of the open scene.

    frames          the scene frame of each frame of the clip, evenly apart (the clip's rate is the scene's over that),
                    also between two; may repeat one (a padded clip holds still)
    normalisation   leads from the cameras' normalised space to the world
    aabb            (2,3) the box over all frames, normalised; None = the whole of [-1,1]
    objects         Blender objects that the cameras see; None = all that the scene shows to renders
    shift           (F,3) normalised: show the scene moved by this at each frame of the clip (`displace`)
    unit            the open scene is so many times as large as what the Sequence's normalisation leads back to
    """

    frames: list[float]
    normalisation: Normalisation
    aabb: np.ndarray | None = None
    objects: list | None = None
    shift: np.ndarray | None = None
    unit: float = 1.0


def capture(
    shots: list[Shot],
    out: Path,
    subject: Subject,
    settings: CaptureSettings | None = None,
    *,
    provenance: dict | None = None,
    started: tuple[float, float] | None = None,
    refuse_empty: str | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Sequence:
    """Renders `shots` of the open scene and writes the Sequence `out`; returns it as read back.

    shots           cameras in normalised space; `Shot.frame` counts the clip's frames, 0…len(subject.frames)-1
    provenance      what the Sequence says of where it came from
    started         when work on it began, as `clocks` had it: the provenance says how many seconds ago by the clock,
                    and how many of the processor's were spent since; None = now
    refuse_empty    pictures of which none shows anything are an InputError that names this
    progress        called with (images done, images in all) after every frame

    Motion vectors hold for a camera that stands still, and lead to where the surface is at the entries of
    `subject.frames` before and after; at the clip's ends, to a step beyond it.
    Raises InputError where there is nothing to render, and for steps over which Blender gives no motion vectors.
    Values that an artist changed without keying them are lost, as after every animation render in Blender; everything
    else is as before.
    """
    settings, started = settings or CaptureSettings(), started or clocks()
    if not shots:
        raise InputError(f"{out}: there is no camera to render; choose a rig and at least one frame.")
    names = _file_names(shots)
    shots = sorted(shots, key=lambda shot: shot.frame)  # each frame is evaluated once
    seq = _sequence_to_fill(shots, subject, settings, provenance)

    def fill(folder: Path) -> None:
        (folder / "images").mkdir()
        if settings.passes:
            (folder / "passes").mkdir()
        if settings.tracks is not None:
            _write_tracks(seq, folder, subject, settings)
        with (
            tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as tmp,
            borrowed(subject.objects, lights=not settings.lighting) as stage,
            temporary_data() as temporary,
        ):
            apply_settings(stage, settings)
            if settings.lighting:
                add_even_light(stage, temporary)
            cameras = MultiViewCameras(stage, temporary, subject.normalisation)
            done, shown = 0, False
            for frame in _render_frames(cameras, shots, subject, settings, Path(tmp)):
                for channels in frame:
                    view = seq.views[done]
                    name = f"{names[view.rig, view.camera]}_{int(view.frame):04d}"
                    shown |= _write_view(view, name, channels, folder, subject, settings)
                    done += 1
                progress(done, len(shots))
            if refuse_empty is not None and not shown:
                raise InputError(
                    f"{refuse_empty}: no picture shows anything, for what is there is transparent or out of sight; "
                    "look at its materials and visibility."
                )
        spent = [round(now - then, 2) for now, then in zip(clocks(), started, strict=True)]
        seq.provenance["seconds"], seq.provenance["cpu_seconds"] = spent

    return write_sequence(seq, out, fill)


def clocks() -> tuple[float, float]:
    """Seconds by the clock, since some moment, and of the processor, of this process and of children that ended."""
    return time.monotonic(), sum(os.times()[:4])


def _file_names(shots: list[Shot]) -> dict[tuple[str, str], str]:
    """(rig, camera) -> what their files are called, without the frame."""
    cameras = list(dict.fromkeys((shot.rig, shot.camera) for shot in shots))
    plain = ["_".join(re.sub(r"[^A-Za-z0-9-]+", "-", text) or "0" for text in camera) for camera in cameras]
    return dict(zip(cameras, distinct(plain), strict=True))


def _sequence_to_fill(
    shots: list[Shot], subject: Subject, settings: CaptureSettings, provenance: dict | None
) -> Sequence:
    """The Sequence, but for the paths of its files: views in the order of `shots`."""
    width, height = settings.width_and_height
    render = bpy.context.scene.render
    return Sequence(
        width=width,
        height=height,
        fps=render.fps / render.fps_base / _scene_frames_per_frame(subject.frames),
        frame_start=0,
        frame_end=len(subject.frames) - 1,
        normalisation=_in_units(subject.normalisation, subject.unit),
        aabb=[[-1.0] * 3, [1.0] * 3] if subject.aabb is None else np.asarray(subject.aabb, float).tolist(),
        provenance=dict(provenance or {}),
        views=[_view(shot, width, height) for shot in shots],
    )


def _in_units(normalisation: Normalisation, unit: float) -> Normalisation:
    x, y, z = normalisation.translation
    return Normalisation(normalisation.scale / unit, (x / unit, y / unit, z / unit))


def _render_frames(
    cameras: MultiViewCameras, shots: list[Shot], subject: Subject, settings: CaptureSettings, tmp: Path
) -> Iterator[list[dict[str, np.ndarray]]]:
    """Renders frame by frame; yields the channels (`read_multilayer`) of each shot of the frame, in the order of
    `shots`. What is all but transparent and has nothing behind it is rendered once more, by one sample, for its depth
    and motion."""
    if subject.shift is not None:
        shots = displace.counter_moved(shots, subject.shift)
    step = _scene_frames_per_frame(subject.frames) if settings.passes else 1
    if step != 1:
        step = lengthen_frames(cameras.stage, step)
    for frame, group in groupby(shots, key=lambda shot: shot.frame):
        go_to(cameras.stage, subject.frames[frame], step)
        if settings.engine == "CYCLES":
            cameras.stage.cycles.seed = settings.seed + frame
        cameras.place(list(group))
        channels = [_read(file) for file in cameras.render(tmp)]
        if settings.passes and settings.engine == "CYCLES" and any(shows_faint_surfaces(c) for c in channels):
            with faint_surfaces_have_depth(cameras.stage):
                for c, file in zip(channels, cameras.render(tmp), strict=True):
                    fill_faint_surfaces(c, _read(file))
        yield channels


def _read(rendered: Path) -> dict[str, np.ndarray]:
    """What Blender rendered. InputError where the file is not whole."""
    try:
        return read_multilayer(rendered)
    except (ValueError, OSError, struct.error, IndexError, KeyError):
        raise InputError(
            f"{rendered.parent}: Blender did not write the picture whole; make space on that disk."
        ) from None


def _write_view(
    view: View, name: str, channels: dict[str, np.ndarray], folder: Path, subject: Subject, settings: CaptureSettings
) -> bool:
    """Turns what Blender rendered into the view's files below `folder`, and sets their paths. Whether it shows
    anything."""
    view.image = f"images/{name}.png"
    rgba = to_straight_srgb(channels["combined"])
    write_png(folder / view.image, rgba)
    if settings.passes:
        view.passes = f"passes/{name}.exr"
        passes = to_passes(channels, subject.normalisation.scale)
        _hold_still(passes, subject.frames, int(view.frame))
        if subject.shift is not None:
            displace.add_flow(passes, view, subject.shift)
        write_passes(folder / view.passes, passes, channels["combined"] if settings.linear else None)
    return bool(rgba[..., 3].any())


def _write_tracks(seq: Sequence, folder: Path, subject: Subject, settings: CaptureSettings) -> None:
    """Writes the surface tracks below `folder`, and sets the Sequence's path and the names of what has none."""
    tracks, seq.untracked = track_surfaces(
        subject.frames,
        subject.normalisation,
        seq.pixel_size,
        settings.tracks or 0,
        objects=subject.objects,
        shift=subject.shift,
        seed=settings.seed,
    )
    if len(tracks):
        seq.tracks = "tracks.npz"
        write_tracks(folder / seq.tracks, tracks)


def _scene_frames_per_frame(frames: list[float]) -> float:
    """Scene frames between two frames of a clip: 1 where there is but one, or they do not go on."""
    return frames[1] - frames[0] if len(frames) > 1 and frames[1] > frames[0] else 1


def _hold_still(passes: Passes, frames: list[float], i: int) -> None:
    """No motion to a frame of the clip that shows the same scene frame, as padded ones do."""
    if i + 1 < len(frames) and frames[i + 1] == frames[i]:
        passes.flow_next[:] = 0
    if i > 0 and frames[i] == frames[i - 1]:
        passes.flow_prev[:] = 0


def _view(shot: Shot, width: int, height: int) -> View:
    side = max(width, height)
    focal = focal_from_fov(shot.fov, side)
    cx, cy = width / 2 - shot.shift[0] * side, height / 2 + shot.shift[1] * side
    return View(shot.frame, shot.camera, shot.rig, shot.c2w, focal, focal, cx, cy)
