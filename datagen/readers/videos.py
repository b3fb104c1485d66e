# SPDX-License-Identifier: GPL-3.0-or-later
"""Frames out of videos, by their number, as they are asked for. PyAV (libav) is imported here alone.

Nothing is kept but a few open files, each at a place of its video: who asks in order pays for decoding once, who does
not for the way from the last key frame. Frames are counted by their time stamps, so that what a file says of their
number does not matter.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from ..sequence import InputError

SUFFIXES = (".mp4", ".mov", ".mkv", ".avi", ".webm", ".m4v")
OPEN = 6  # files that are open at a time; of a decoder are some ten frames in memory
LEAP = 48  # frames; decoding so many is no slower than to look for a key frame


@dataclass(frozen=True)
class Video:
    """What a file holds."""

    width: int
    height: int
    rate: float  # frames a second, on average
    stamps: tuple[int, ...]  # of its frames, in the order in which they are shown


def library():
    """PyAV. Raises InputError where it is not installed."""
    try:
        import av
    except ModuleNotFoundError:
        raise InputError("reading videos needs PyAV; install it: pip install 'timesplat[video]'.") from None
    av.logging.set_level(None)
    return av


def video_of(path: Path) -> Video:
    """Size, rate and time stamps of a video, without decoding it. Raises InputError naming the file."""
    try:
        stamp = path.stat().st_mtime_ns
    except OSError:
        raise InputError(f"{path}: the video is missing; correct the folder, or get the data set again.") from None
    return _video_of(path, stamp)


@lru_cache(maxsize=256)
def _video_of(path: Path, stamp: int) -> Video:
    av = library()
    try:
        with av.open(str(path)) as file:
            stream = file.streams.video[0]
            stamps = sorted(p.pts for p in file.demux(stream) if p.pts is not None)
            rate = stream.average_rate or stream.guessed_rate
            width, height = stream.codec_context.width, stream.codec_context.height
    except (av.FFmpegError, OSError, ValueError, IndexError) as e:
        raise _damaged(path, e) from None
    if not stamps or not rate or min(width, height) < 2:
        raise _damaged(path, "it has no frames")
    return Video(width, height, float(rate), tuple(stamps))


def _damaged(path: Path, why: object) -> InputError:
    return InputError(f"{path}: the video cannot be read ({why}); encode it anew, or get the data set again.")


class _Cursor:
    """An open video, and the frame that it is at."""

    def __init__(self, path: Path):
        self.path, self.video = path, video_of(path)
        self.file = library().open(str(path))
        self.stream = self.file.streams.video[0]
        self.stream.thread_type = "AUTO"
        self.next, self.frames = 0, self.file.decode(self.stream)

    def read(self, index: int) -> np.ndarray:
        stamps = self.video.stamps
        if not self.next <= index <= self.next + LEAP:
            self.file.seek(stamps[index], stream=self.stream, backward=True, any_frame=False)
            self.frames = self.file.decode(self.stream)
        for frame in self.frames:
            if frame.pts is not None and frame.pts >= stamps[index]:
                self.next = index + 1
                return frame.to_ndarray(format="rgb24")
        raise _damaged(self.path, f"it ends before frame {index}")


_cursors: OrderedDict[Path, _Cursor] = OrderedDict()  # the one used last is at the end
_one_at_a_time = threading.Lock()


def read_frame(path: Path, index: int) -> np.ndarray:
    """(H,W,4) uint8 RGBA, opaque, of a video's frame, the first of which is 0. Raises InputError naming the file."""
    av = library()
    with _one_at_a_time:
        try:
            cursor = _cursors.pop(path, None) or _Cursor(path)
            rgb = cursor.read(index)
        except (av.FFmpegError, OSError, ValueError, IndexError) as e:
            raise (e if isinstance(e, InputError) else _damaged(path, e)) from None
        _cursors[path] = cursor
        while len(_cursors) > OPEN:
            _cursors.popitem(last=False)[1].file.close()
    return np.concatenate([rgb, np.full((*rgb.shape[:2], 1), 255, np.uint8)], -1)
