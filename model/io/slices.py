# SPDX-License-Identifier: GPL-3.0-or-later
"""Moments of a 4D asset for tools that know nothing of time: files of slice_formats.py, or a folder with one a frame.
numpy and the standard library only, for inside Blender.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from ...datagen.sequence import InputError
from .asset import VISIBLE, Asset, check, static_asset
from .atomic import atomic_write, new_folder
from .placement import rotate_quaternions
from .slice_formats import SLICE_FORMATS

MINUS_Y_UP = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], np.float32)  # (x, y, z) of Z up -> (x, -z, y)


def slice_at(asset: Asset, frame: float, cut: float = VISIBLE) -> Asset:
    """What is visible at a (fractional) frame as an asset that does not change, for tools that know nothing of
    time: in world units, with Z turned to -Y, which those take for up; scales are `soft_scale`. Beyond the
    clip's ends it is held, as on the timeline. Where nothing has the opacity `cut` the least faint Gaussian
    stays, of several the nearest to the middle, because empty files are refused by many, and files of what is
    elsewhere than anything can be."""
    clip = asset.clip
    held = min(max(frame, clip.frame_start), clip.frame_end)
    time = clip.frame_to_time(held)
    xyz, opacity = asset.at(time)
    seen = opacity >= cut
    if not seen.any():
        seen[np.lexsort((np.abs(xyz).max(1), -opacity))[:1]] = True
    world = xyz[seen] * np.float32(clip.scale) + np.array(clip.translation, np.float32)
    return static_asset(
        "the slice",
        xyz=world @ MINUS_Y_UP.T,
        scale=asset.soft_scale()[seen] * np.float32(clip.scale),
        rotation=rotate_quaternions(MINUS_Y_UP, asset.rotation_at(time)[seen]),
        rgb=asset.rgb[seen],
        opacity=opacity[seen],
    )


def write_slice(path: str | Path, asset: Asset, frame: float, cut: float = VISIBLE) -> int:
    """Writes `slice_at` as one of SLICE_FORMATS, by the suffix; whole or not at all. Returns the
    number of Gaussians. Raises InputError."""
    path = Path(path)
    check(asset, path)
    if np.isnan(frame):
        raise InputError(f"{frame}: the frame must be a number; give one.")
    encode = _encoder(path, path.suffix.lower())
    try:
        part = slice_at(asset, frame, cut)
        data = encode(part, frame)
    except InputError as e:
        raise InputError(f"{path}: {e}") from None
    with atomic_write(path) as tmp:
        tmp.write_bytes(data)
    return len(part)


def _encoder(path: Path, suffix: str):
    if suffix not in SLICE_FORMATS:
        raise InputError(f"{path}: the name of a slice must end in {', '.join(SLICE_FORMATS)}; choose one of these.")
    return SLICE_FORMATS[suffix]


def write_slices(folder: str | Path, asset: Asset, stem: str, suffix: str = ".ply") -> int:
    """`write_moments` of every frame of the clip."""
    check(asset, folder)
    return write_moments(folder, ((frame, asset) for frame in asset.clip.frames), stem, suffix=suffix)


def write_moments(
    folder: str | Path, moments: Iterable[tuple[int, Asset]], stem: str, cut: float = VISIBLE, suffix: str = ".ply"
) -> int:
    """Writes a file of a suffix of SLICE_FORMATS for each (frame, asset) into a new folder, stem_0001.ply and so on by
    the frame's number; the folder appears whole or not at all. Returns the number of files. Raises InputError, also if
    the folder exists and is not empty."""
    folder, count = Path(folder), 0
    encode = _encoder(folder / f"{stem}_0001{suffix}", suffix)
    with new_folder(folder) as whole:
        for frame, asset in moments:
            count += 1
            (whole / f"{stem}_{frame:04d}{suffix}").write_bytes(encode(slice_at(asset, frame, cut), frame))
    return count
