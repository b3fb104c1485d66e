# SPDX-License-Identifier: GPL-3.0-or-later
"""What is to be rendered: names of assets, the settings, and whether a Sequence is already what they ask for.

`farm` and `render_asset`, on the two sides of a process, agree on it. Without bpy.
"""

from __future__ import annotations

import hashlib
import os
import re
from dataclasses import asdict, dataclass
from pathlib import Path

from . import ASSET_SUFFIXES
from .rigs import RIGS
from .sequence import InputError, read_sequence

FIRST_CLIP, MOST_MOVING_CLIP, ALL_CLIPS = "first", "most-moving", "all"  # what `RenderSettings.clip` may be
_TRACKS = {"auto": 0, "none": None}
_LEAST = {"frames": 1, "size": 8, "samples": 1, "targets": 0, "seed": 0}


@dataclass(frozen=True)
class RenderSettings:
    """What decides the pictures; recorded in the Sequence, and compared when a run resumes. InputError for what is
    no rig or too small."""

    rig: str = "default"  # a name in rigs.RIGS
    targets: int = 0  # held-out random views a frame
    clip: str = MOST_MOVING_CLIP  # "most-moving", "first", "all" or a clip's name
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
        if self.tracks not in _TRACKS and not re.fullmatch(r"[1-9][0-9]{0,6}", self.tracks):
            raise InputError(f"--tracks {self.tracks}: not a number of points; give one, auto or none.")

    @property
    def track_count(self) -> int | None:
        """As `CaptureSettings.tracks` has it."""
        return _TRACKS[self.tracks] if self.tracks in _TRACKS else int(self.tracks)


def expand_folders(assets: list[str]) -> list[str]:
    """Folders -> the assets in them, sorted; files and "zoo:SEED" stay. InputError for an empty folder."""
    found = []
    for asset in map(str, assets):
        path = Path(asset)
        if path.is_dir():
            files = [Path(root, name) for root, _, names in os.walk(path) for name in names]
            inside = sorted(str(f) for f in files if f.suffix.lower() in ASSET_SUFFIXES)
            if not inside:
                raise InputError(f"{path}: there is no asset in this folder; {', '.join(ASSET_SUFFIXES)} are read.")
            found += inside
        else:
            found.append(asset)
    return list(dict.fromkeys(found))


def asset_name(asset: str) -> str:
    """What an asset is called in folders and seeds: a file's name without its ending, "zoo-000007" for "zoo:7"."""
    if seed := zoo_seed(asset):
        return f"zoo-{int(seed):06d}"
    return Path(asset).stem


def zoo_seed(asset: str) -> str | None:
    """The digits of "zoo:SEED", None for a file."""
    match = re.fullmatch(r"zoo:(\d+)", asset)
    return match[1] if match else None


def rendered_clips(folder: Path, asset: str, settings: RenderSettings) -> int:
    """How many clips the run had that made the Sequence in `folder`, if it is whole and shows this very asset with
    these settings; else 0."""
    try:
        provenance = read_sequence(folder).provenance
        same = provenance["settings"] == asdict(settings) and provenance["asset"] == Path(asset).name
        if same and not zoo_seed(asset):
            same = provenance["sha256"] == hashlib.sha256(Path(asset).read_bytes()).hexdigest()
        return provenance["clips"] if same else 0
    except (InputError, KeyError, OSError):
        return 0


def finished_sequences(folder: Path, asset: str, settings: RenderSettings) -> list[Path]:
    """The Sequences of this asset with these settings below `folder`, if all its clips are there and whole; else
    none."""
    folders = [file.parent for file in sorted(folder.glob("*/transforms.json"))]
    clips = {f: count for f in folders if (count := rendered_clips(f, asset, settings))}
    return list(clips) if clips and len(clips) == max(clips.values()) else []
