# SPDX-License-Identifier: GPL-3.0-or-later
"""Moments as others write them, in seconds, 0..1, frame numbers or file names, as frames of a clip."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np

from ..sequence import InputError, frame_number

FPS = 24.0  # where nothing tells the rate
SNAP = 1e-3  # frames: as much rounding of a printed time is taken back
STILL = "none"  # as a pattern: the pictures show one moment
_FRAME_FOLDER = re.compile(r"(?:frame|time|step)s?[_-]?(\d+(?:\.\d+)?)", re.IGNORECASE)
_FRAME_FILE = re.compile(r"(?:frame|time|step)[_-]?(\d+(?:\.\d+)?)[_-](.+)", re.IGNORECASE)
_LAST_NUMBER = re.compile(r"(\d+)(?!.*\d)")


@dataclass(frozen=True)
class Clip:
    """Each picture's frame, and what the clip is."""

    frames: list[float]  # int where whole
    start: int
    end: int
    fps: float
    told: str  # in words, where it is from


def clip_of(names: list[str], times: list[float | None], frames: list[float | None], fps: float | None,
            stated: tuple[int | None, int | None], path) -> Clip:  # fmt: skip
    """The clip of pictures with their names, `time` and `frame` entries (None where there is none), the rate and the
    range that are stated, if any. Frame numbers hold where they go with the times; else the times do. Those are 0..1
    over the clip, whole frame numbers, or seconds. Raises InputError naming `path` where some pictures have a time and
    others have none, where one is not finite, and where all are the same although there are several pictures."""
    for what, values in (("time", times), ("frame", frames)):
        lacking = [n for n, x in zip(names, values, strict=True) if x is None]
        if lacking and len(lacking) < len(names):
            raise InputError(f"{path}: {lacking[0]} has no {what}, others have; give one to each, or to none.")
        odd = [n for n, x in zip(names, values, strict=True) if x is not None and not np.isfinite(x)]
        if odd:
            raise InputError(f"{path}: the {what} of {odd[0]} is not a finite number; correct it.")
    t = None if times[0] is None else np.array(times, float)
    f = None if frames[0] is None else np.array(frames, float)
    if t is None and f is None:
        return Clip([0] * len(names), 0, 0, fps or FPS, "no times, so it stands still")
    if len(names) > 1 and all(np.ptp(x) == 0 for x in (t, f) if x is not None):
        raise InputError(
            f"{path}: all of its times are the same although it has {len(names)} pictures; correct them, or pass "
            "--times none where they show one moment."
        )
    if f is not None and t is not None and np.ptp(t) > 0:
        slope, shift = np.polyfit(f, t, 1) if np.ptp(f) > 0 else (0.0, 0.0)
        if slope <= 0 or np.abs(slope * f + shift - t).max() > 1e-3 * np.ptp(t):
            return _of_times(t, fps, "time (the frame numbers contradict it)")
        if fps is None and _seconds(t):
            fps = _round(1 / slope)
    if f is not None:
        return _clip(f, stated, fps or FPS, "frame numbers")
    assert t is not None
    return _of_times(t, fps, "time")


def of_names(names: list[str], pattern: str | None) -> tuple[list[float | None], list[str | None]]:
    """Frame numbers and cameras that the pictures' paths tell, None where they tell none. pattern: a regular expression
    with a group around the frame's number, and perhaps one named `camera`; or `none`. Without one, names tell the time
    where all do as in `frame_0012_cam3.png`, where folders do as in `frame_0012/cam3.png`, or where several folders,
    one a camera, hold the same numbers. Raises InputError for a pattern that is no expression, has no group, or does
    not fit a name."""
    nothing: tuple[list[float | None], list[str | None]] = [None] * len(names), [None] * len(names)
    if pattern == STILL:
        return nothing
    if pattern is not None:
        try:
            compiled = re.compile(pattern)
        except re.error as e:
            raise InputError(f"--times {pattern}: it is no regular expression ({e}).") from None
        if not compiled.groups:
            raise InputError(f"--times {pattern}: put round brackets around what is the frame's number.")
        return _by_pattern(names, compiled, pattern)
    paths = [PurePosixPath(n) for n in names]
    flat = [_FRAME_FILE.fullmatch(p.stem) for p in paths]
    if all(flat) and len({m[1] for m in flat if m}) > 1:
        return [float(m[1]) for m in flat if m], [m[2] for m in flat if m]
    above = [_FRAME_FOLDER.fullmatch(p.parent.name) for p in paths]
    if all(above) and len({p.parent for p in paths}) > 1:
        return [float(m[1]) for m in above if m], [p.stem for p in paths]
    numbers = [_LAST_NUMBER.search(p.stem) for p in paths]
    folders: dict[PurePosixPath, list[str]] = {}
    for p, m in zip(paths, numbers, strict=True):
        folders.setdefault(p.parent, []).append(m[1] if m else "")
    shared = set.intersection(*(set(x) for x in folders.values()))
    if len(folders) > 1 and len(shared - {""}) > 1 and all(numbers):
        return [float(m[1]) for m in numbers if m], [p.parent.name for p in paths]
    return nothing


def _by_pattern(names: list[str], compiled: re.Pattern, pattern: str) -> tuple[list[float | None], list[str | None]]:
    frames: list[float | None] = []
    cameras: list[str | None] = []
    group = next((g for g in range(1, compiled.groups + 1) if g != compiled.groupindex.get("camera")), None)
    for name in names:
        m = compiled.search(name)
        try:
            frames.append(float(m[group]))  # type: ignore[index]
        except (TypeError, ValueError):
            raise InputError(f"--times {pattern}: it finds no number in {name}; correct the pattern.") from None
        rest = name[: m.start(group)] + "*" + name[m.end(group) :]  # type: ignore
        cameras.append(m["camera"] if m and "camera" in compiled.groupindex else rest)
    return frames, cameras


def _of_times(t: np.ndarray, fps: float | None, told: str) -> Clip:
    distinct = np.unique(np.round(t, 6))
    within = t.min() >= 0 and t.max() <= 1 + 1e-6
    # Half a second of a clip at a stated rate is in 0..1 as well: then every time is a whole number of its frames.
    seconds = bool(fps) and t.max() < 1 and np.abs(t * (fps or 1) - np.round(t * (fps or 1))).max() < 10 * SNAP
    if within and not seconds:
        last = max(len(distinct) - 1, 1)
        return _clip(t * last, (0, last), fps or FPS, f"{told}, 0..1 over the clip")
    if not seconds and not _seconds(t):
        return _clip(t, (None, None), fps or FPS, f"{told}, in frames")
    rate = fps or _round(1 / float(np.median(np.diff(distinct))))
    return _clip((t - t.min()) * rate, (None, None), rate, f"{told}, in seconds")


def _seconds(t: np.ndarray) -> bool:
    """Whether times can be neither 0..1 over the clip nor numbers of frames."""
    return t.max() > 1 + 1e-6 and np.abs(t - np.round(t)).max() > 1e-9


def _clip(f: np.ndarray, stated: tuple[int | None, int | None], fps: float, told: str) -> Clip:
    near = np.round(f)
    frames = [frame_number(n if abs(n - x) < SNAP else x) for n, x in zip(near.tolist(), f.tolist(), strict=True)]
    start, end = int(np.floor(min(frames))), int(np.ceil(max(frames)))
    start = start if stated[0] is None else min(start, stated[0])
    end = end if stated[1] is None else max(end, stated[1])
    return Clip(frames, start, end, fps, told)


def _round(rate: float) -> float:
    """A rate that was measured, as it was meant."""
    return float(round(rate)) if abs(rate - round(rate)) < 0.02 * rate else rate
