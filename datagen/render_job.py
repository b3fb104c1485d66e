# SPDX-License-Identifier: GPL-3.0-or-later
"""What is to be rendered: names of assets, the settings, and whether a Sequence is already what they ask for.

`farm` and `render_asset`, on the two sides of a process, agree on it. Without bpy.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path, PurePosixPath

from . import ASSET_SUFFIXES
from .rigs import RIGS
from .sequence import InputError, read_sequence

FIRST_CLIP, MOST_MOVING_CLIP, ALL_CLIPS = "first", "most-moving", "all"  # what `RenderSettings.clip` may be
SINGLE, CONSECUTIVE = CLIPS = ("single", "consecutive")  # what `RenderSettings.clips` may be
_TRACKS = {"auto": 0, "none": None}
_LEAST = {"start": 0, "every": 1, "frames": 1, "size": 8, "samples": 1, "targets": 0, "seed": 0}


@dataclass(frozen=True)
class RenderSettings:
    """What decides the pictures; recorded in the Sequence, and compared when a run resumes. InputError for what is
    no rig or too small."""

    rig: str = "default"  # a name in rigs.RIGS
    targets: int = 0  # held-out random views a frame
    clip: str = MOST_MOVING_CLIP  # "most-moving", "first", "all" or a clip's name
    clips: str = SINGLE  # of a long animation: "single", its first frames, or "consecutive", all of it in clips
    start: int = 0  # frames of the animation that are passed over
    every: int = 1  # scene frames from one frame of the clip to the next
    spread: bool = False  # the clip's frames evenly over the whole animation, at fractions of scene frames
    frames: int = 24
    size: int = 128  # pixels of the square pictures' sides
    samples: int = 16  # a pixel
    passes: bool = True  # also depth and motion vectors
    linear: bool = False  # also the scene-linear picture, in the passes
    tracks: str = "auto"  # surface points followed through the clip: "auto", "none", or so many
    displace: bool = False  # take a still object and move it a little, see `displace`
    seed: int = 0
    device: str = "CPU"  # or "GPU"

    def __post_init__(self):
        if self.rig not in RIGS:
            raise InputError(f"--rig {self.rig}: there is no such rig; choose one of {', '.join(RIGS)}.")
        for name, least in _LEAST.items():
            if getattr(self, name) < least:
                raise InputError(f"--{name} {getattr(self, name)}: too small; give {least} or more.")
        if self.clips not in CLIPS:
            raise InputError(f"--clips {self.clips}: there is no such way; choose one of {', '.join(CLIPS)}.")
        if self.spread and (self.every > 1 or self.clips == CONSECUTIVE):
            raise InputError("--spread: it chooses the frames itself; drop --every and --clips consecutive.")
        if self.tracks not in _TRACKS and not re.fullmatch(r"[1-9][0-9]{0,6}", self.tracks):
            raise InputError(f"--tracks {self.tracks}: not a number of points; give one, auto or none.")

    @property
    def track_count(self) -> int | None:
        """As `CaptureSettings.tracks` has it."""
        return _TRACKS[self.tracks] if self.tracks in _TRACKS else int(self.tracks)


@dataclass(frozen=True)
class Part:
    """The assets of one of several machines. An asset's name alone decides which part it is in: all machines agree on
    it, and no asset is in two. InputError for a part that there is not."""

    number: int  # from 1
    of: int

    def __post_init__(self):
        if not 1 <= self.number <= self.of:
            raise InputError(f"--shard {self}: there is no such part; count from 1/{self.of} to {self.of}/{self.of}.")

    def __str__(self) -> str:
        return f"{self.number}/{self.of}"

    @staticmethod
    def parse(text: str) -> Part:
        """Of "2/8"."""
        match = re.fullmatch(r"([0-9]{1,9})/([1-9][0-9]{0,8})", text)
        if not match:
            raise InputError(f"--shard {text}: not a part; write for example 2/8, the second of eight machines.")
        return Part(int(match[1]), int(match[2]))

    def holds(self, name: str) -> bool:
        """Whether the asset of this name is in it; capitals count for nothing, as in `list_assets`."""
        digest = hashlib.sha256(name.lower().encode("utf-8", "surrogateescape")).digest()
        return int.from_bytes(digest, "big") % self.of == self.number - 1


@dataclass(frozen=True)
class Asset:
    """One thing to render."""

    path: str  # of a file, or "zoo:SEED"
    name: str  # of its folder below the run's, with "/" between parts; its cameras are drawn from it
    root: str | None = None  # folder below which paths in the file may lead; None = the file's own

    @property
    def below_root(self) -> str:
        """The path from the root on, which is the same on every machine; what can be seen of a file depends on it."""
        return _relative(self.path, self.root) if self.root else Path(self.path).name


def list_assets(given: list[str], root: Path | None = None) -> list[Asset]:
    """The assets of folders, sorted, of files, and "zoo:SEED". Names are the paths below `root`, or else below the
    folder that was given (a file given alone: its name), without endings; with them where two would be one, or one the
    other's folder. InputError for an empty folder, and for a file outside of `root`."""
    found: dict[str, str | None] = {}  # path -> root
    for asset in map(str, given):
        path = Path(asset)
        if path.is_dir():
            files = [Path(folder, name) for folder, _, names in os.walk(path) for name in names]
            inside = sorted(str(f) for f in files if f.suffix.lower() in ASSET_SUFFIXES)
            if not inside:
                raise InputError(f"{path}: there is no asset in this folder; {', '.join(ASSET_SUFFIXES)} are read.")
            for file in inside:
                found.setdefault(file, str(root or path))
        else:
            found.setdefault(asset, str(root) if root and not zoo_seed(asset) else None)
    plain = {path: asset_name(path, root) for path, root in found.items()}
    keys = [name.lower() for name in plain.values()]  # one folder for both on Windows and macOS
    folders = {parent.as_posix() for key in set(keys) for parent in PurePosixPath(key).parents}
    taken = {key for key, count in Counter(keys).items() if count > 1 or key in folders}
    return [
        Asset(path, name + Path(path).suffix.lower().replace(".", "-") if name.lower() in taken else name, found[path])
        for path, name in plain.items()
    ]


def asset_name(asset: str, root: str | None = None) -> str:
    """What an asset is called in folders and seeds: the path of a file below `root`, or its name, without its ending;
    "zoo-000007" for "zoo:7". InputError for a file that is not below it."""
    if seed := zoo_seed(asset):
        return f"zoo-{int(seed):06d}"
    return PurePosixPath(_relative(asset, root) if root else Path(asset).name).with_suffix("").as_posix()


def _relative(path: str, root: str) -> str:
    relative = Path(os.path.relpath(path, root))
    if relative.is_absolute() or relative.parts[0] == "..":
        raise InputError(f"{path}: it lies outside of --root {root}; give a folder that holds it.")
    return relative.as_posix()


def zoo_seed(asset: str) -> str | None:
    """The digits of "zoo:SEED", None for a file."""
    match = re.fullmatch(r"zoo:(\d+)", asset)
    return match[1] if match else None


def file_sha256(asset: Asset) -> str:
    """In hexadecimal; "" for what is no file, and for one that cannot be read."""
    try:
        return hashlib.sha256(Path(asset.path).read_bytes()).hexdigest() if Path(asset.path).is_file() else ""
    except OSError:
        return ""


def rendered_clips(folder: Path, asset: Asset, settings: RenderSettings) -> int:
    """How many clips the run had that made the Sequence in `folder`, if it is whole and shows this very asset with
    these settings; else 0."""
    try:
        provenance = read_sequence(folder).provenance
        same = provenance["settings"] == asdict(settings) and provenance["asset"] == Path(asset.path).name
        if same and not zoo_seed(asset.path):
            same = provenance["path"] == asset.below_root
            same &= provenance["sha256"] == file_sha256(asset)
        return provenance["clips"] if same else 0
    except (InputError, KeyError, OSError):
        return 0


def rendered_sequences(folder: Path, asset: Asset, settings: RenderSettings) -> tuple[list[Path], bool]:
    """The Sequences of this asset with these settings below `folder`, and whether all its clips are there and whole."""
    folders = [file.parent for file in sorted(folder.glob("*/transforms.json"))]
    clips = {f: count for f in folders if (count := rendered_clips(f, asset, settings))}
    return list(clips), bool(clips) and len(clips) == max(clips.values())
