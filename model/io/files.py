# SPDX-License-Identifier: GPL-3.0-or-later
"""Every file that an asset can be read from or written to, by its suffix: a new format is one entry in a table here.
No torch, and pxr only when a USD file is read or written, so that it runs inside Blender."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...datagen.sequence import InputError
from .asset import ARRAYS, MAX_GAUSSIANS, ONE_FRAME_SIGMA, STATIC_SIGMA_T, Asset, Clip, LoadedAsset, check
from .fourdgs_file import read_4dgs, write_4dgs
from .page import read_page, write_page
from .pieces import to_pieces
from .placement import place_asset
from .ply import write_ply
from .slice_formats import SLICE_FORMATS
from .slices import write_slice
from .sog import read_sog
from .splat_files import read_any_ply, read_splat, read_spz
from .usd_apart import load_usd_apart
from .usd_read import load_usd
from .usd_stage import USD_SUFFIXES
from .usd_write import write_usd


def _read_usd(path: Path) -> LoadedAsset:
    """In a process of its own, for the library dies over some damaged files. In Blender, where there may be no other
    Python that has it, here: its importer asks the worker first."""
    return load_usd(path) if "bpy" in sys.modules else load_usd_apart(path)


READERS: dict[str, Callable[[Path], LoadedAsset]] = {
    ".ply": read_any_ply,
    ".splat": read_splat,
    ".spz": read_spz,
    ".sog": read_sog,
    ".4dgs": read_4dgs,
    ".html": read_page,
    **dict.fromkeys(USD_SUFFIXES, _read_usd),
}
WRITERS: dict[str, Callable[..., None]] = {
    ".ply": write_ply,
    ".4dgs": write_4dgs,
    ".html": write_page,
    **dict.fromkeys(USD_SUFFIXES, write_usd),
}
READABLE, WRITABLE = tuple(READERS), tuple(WRITERS)
FRAME_SUFFIXES = tuple(s for s in SLICE_FORMATS if s in READERS)  # of files that may be the frames of a sequence
STRAIGHT = (".4dgs",)  # formats that know no paths
APART = (*USD_SUFFIXES, ".sog", ".4dgs")  # by libraries that Blender lacks, so that there the worker reads and writes


def named(suffixes: Iterable[str]) -> str:
    """Suffixes in words, those of USD as one."""
    kept = dict.fromkeys(".usd*" if s in USD_SUFFIXES else s for s in suffixes)
    return ", ".join(kept)


def read_asset(path: str | Path, *, fps: float = 24.0, frame_start: int = 1) -> LoadedAsset:
    """Reads a file by its suffix, one of READABLE; or, from a folder, its `frame_files` as the frames of a sequence
    (see `read_frames`, also for `fps` and `frame_start`, which count for nothing else). Raises InputError: one sentence
    that names the file and says what it is and what was expected."""
    path = Path(path)
    paths = frame_files(path) if path.is_dir() else [path]
    return read_frames(paths, fps=fps, frame_start=frame_start)


def write_asset(path: str | Path, asset: Asset, *, frame: float | None = None, pieces: bool = False, **options) -> int:
    """Writes the whole asset, to a suffix of WRITABLE, or what is visible at a frame (see `slices.write_slice`); the
    file appears whole or not at all. `pieces`: straight Gaussians in place of those on paths (see `to_pieces`), which
    .4dgs needs in any case.
    `options` are those of the format's writer: `write_usd` has some. Returns the number of Gaussians written. Raises
    InputError."""
    if pieces or Path(path).suffix.lower() in STRAIGHT:
        check(asset, path)
        asset = to_pieces(asset)
    if frame is not None:
        return write_slice(path, asset, frame, **options)
    writer = WRITERS.get(Path(path).suffix.lower())
    if writer is None:
        raise InputError(f"{path}: cannot write that; choose {named(WRITABLE)}.")
    writer(path, asset, **options)
    return len(asset)


# ---------------------------------------------------------------- what is up


UP_AXES = {"Z": (0, 0, 1), "Y": (0, 1, 0), "-Y": (0, -1, 0)}  # of files


def upright(loaded: LoadedAsset, up: str | None = None) -> Asset:
    """The asset turned about X so that Z is up, in place of `up`, one of UP_AXES; by default what is known of the
    file. Exact but for rounding (see `place_asset`)."""
    _, y, z = UP_AXES[up or loaded.up]
    if z:
        return loaded.asset
    clip = loaded.asset.clip
    turn, own = np.eye(4), np.diag([clip.scale, clip.scale, clip.scale, 1.0])
    turn[1:3, 1:3] = [[0, -y], [y, 0]]
    own[:3, 3] = clip.translation
    return place_asset(loaded.asset, turn @ own)


# ---------------------------------------------------------------- a file a frame


def read_frames(paths: Iterable[str | Path], *, fps: float = 24.0, frame_start: int = 1) -> LoadedAsset:
    """One asset from a file a frame, in the natural order of the names (2 before 10): file k is frame
    frame_start + k, and fps of them are a second. One file alone is read as what it is.

    The Gaussians of a file stand still and have σ_t = ONE_FRAME_SIGMA frames: at their own frame they have their whole
    opacity, at the neighbouring ones exp(-4.5) = 1.1 % of it, which is below VISIBLE, and half-way between
    two frames 32 %, so that both files are seen faintly. Raises InputError, also where files are 4D already
    or differ in their up axis."""
    files = sorted(map(Path, paths), key=_natural_order)
    if not files:
        raise InputError("No file was chosen; choose the .ply files of a sequence.")
    if len(files) == 1:
        return _read_file(files[0])
    if any(path.suffix.lower() in USD_SUFFIXES for path in files):
        raise InputError("USD files hold their frames themselves; import them one by one.")
    clip = Clip(fps, frame_start, frame_start + len(files) - 1)
    sigma_t = np.float32(ONE_FRAME_SIGMA * 2 / (len(files) - 1))
    parts: list[Asset] = []
    middle = np.zeros(3)  # from which all count, where they are far from the origin
    ups, notes, total = set(), [], 0
    for frame, path in zip(clip.frames, files, strict=True):
        loaded = _read_file(path)
        asset, n = loaded.asset, len(loaded.asset)
        total += n
        ups.add(loaded.up)
        notes.append(loaded.note)
        if len(ups) > 1 or asset.paths is not None or (asset.sigma_t != STATIC_SIGMA_T).any():
            raise InputError(f"{path}: it is no frame of a sequence (4D already, or of another kind); import it alone.")
        if total > MAX_GAUSSIANS:
            raise InputError(
                f"{path}: with it the sequence has more than {MAX_GAUSSIANS:,} Gaussians; choose fewer files."
            )
        own = np.full(n, clip.frame_to_time(frame), np.float32)
        middle = middle if parts else np.array(asset.clip.translation)
        xyz = (asset.xyz + (np.array(asset.clip.translation) - middle)).astype(np.float32)
        parts.append(replace(asset, xyz=xyz, t=own, sigma_t=np.full(n, sigma_t)))
    x, y, z = middle.tolist()
    clip = replace(clip, translation=(x, y, z))
    asset = Asset(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in ARRAYS}, clip=clip)
    check(asset, files[0].parent)
    return LoadedAsset(asset, ups.pop(), next(filter(None, notes), ""))


def frame_files(folder: str | Path) -> list[Path]:
    """The files right in a folder that have the first of FRAME_SUFFIXES that any has, in natural order. Raises
    InputError if there is none."""
    folder = Path(folder)
    try:
        there = [p for p in folder.iterdir() if not p.name.startswith(".")]
    except OSError as e:
        raise InputError(f"{folder}: it cannot be read ({e.strerror or e}); check the folder.") from None
    for suffix in FRAME_SUFFIXES:
        if found := [p for p in there if p.suffix.lower() == suffix]:
            return sorted(found, key=_natural_order)
    kinds = named(FRAME_SUFFIXES)
    raise InputError(f"{folder}: there is no {kinds} in this folder; choose one with a file a frame.")


def _read_file(path: Path) -> LoadedAsset:
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise InputError(f"{path}: its name must end in {named(READABLE)}; choose one of these.")
    if path.is_dir():
        raise InputError(f"{path}: it is a folder; choose a {path.suffix} file.")
    try:
        return reader(path)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; check the name.") from None
    except OSError as e:
        raise InputError(f"{path}: it cannot be read ({e.strerror or e}); check the file.") from None
    except MemoryError:
        raise InputError(f"{path}: it takes more memory than there is; close other programs or reduce it.") from None


def _natural_order(path: Path) -> list[tuple[int, str]]:
    """Sort key: numbers in names count by their value."""
    return [(int(w), "") if w.isdecimal() else (-1, w.lower()) for w in re.split(r"(\d+)", path.name) if w]
