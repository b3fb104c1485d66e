# SPDX-License-Identifier: GPL-3.0-or-later
"""The one door to Sequences on disk, whoever wrote them: which of the readers a folder is for. Without torch."""

from __future__ import annotations

import copy
import json
import os
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path

import numpy as np

from ..sequence import FORMAT, InputError, Sequence, read_sequence
from .colmap import model_folder, read_colmap
from .dnerf import SPLITS, read_dnerf
from .easymocap import PAIR, TABLES, camera_files, read_easymocap
from .llff import FILE as LLFF
from .llff import read_llff
from .options import ReadOptions
from .options import add_arguments as add_arguments  # for commands, with the next
from .options import from_arguments as from_arguments
from .panoptic import SPLITS as META_SPLITS
from .panoptic import read_panoptic
from .posed import PosedScene, arrange, assemble, at_rate, placed
from .transforms import read_transforms

OURS, DNERF, PANOPTIC = "transforms.json", "transforms_train.json", "train_meta.json"
DEFAULTS = ReadOptions()


@dataclass(frozen=True)
class Layout:
    """Others' layout that says nothing but pictures and cameras, all else is found out."""

    read: Callable[[Path], PosedScene]
    files: Callable[[Path], list[Path]]  # that describe it


def _colmap_files(folder: Path) -> list[Path]:
    model = model_folder(folder)
    return sorted(p for p in model.iterdir() if p.suffix in (".bin", ".txt")) if model else []


TRANSFORMS = Layout(read_transforms, lambda folder: [folder / OURS])
META = Layout(read_panoptic, lambda folder: [p for p in (folder / n for n in META_SPLITS) if p.is_file()])
COLMAP = Layout(read_colmap, _colmap_files)
MOCAP = Layout(read_easymocap, camera_files)
POSES = Layout(read_llff, lambda folder: [folder / LLFF])
LAYOUTS = "D-NeRF, nerfstudio, instant-ngp, COLMAP, Panoptic, EasyMocap, LLFF or Neu3D"


def open_sequence(folder: Path, options: ReadOptions = DEFAULTS) -> Sequence:
    """The Sequence in a folder, by what it holds: `transforms.json` of ours, or of nerfstudio or instant-ngp;
    `transforms_train.json` of D-NeRF and NeRF's synthetic scenes; `train_meta.json` of Panoptic; `intri.yml` and its
    like of EasyMocap; `poses_bounds.npy` of LLFF and Neu3D; COLMAP's tables.
    options: what the user says of others' data. Raises InputError where there is none of these, and as `read_sequence`,
    `read_dnerf` and `assemble` do."""
    folder = Path(folder)
    if _layout(folder):
        stamps = tuple(path.stat().st_mtime_ns for path in described_by(folder))
        return copy.deepcopy(_assembled(folder.absolute(), stamps, options))
    told = [f"--{f.name}" for f in fields(options) if getattr(options, f.name) != f.default]
    ours = (folder / OURS).is_file()
    told = [name for name in told if ours or name not in ("--background", "--axes", "--fps")]
    if told and (ours or (folder / DNERF).is_file()):
        raise InputError(f"{folder}: {told[0]} is for layouts that leave it open; this one says it itself.")
    if ours:
        return read_sequence(folder)
    if (folder / DNERF).is_file():
        return read_dnerf(folder, options)
    raise InputError(
        f"{folder / OURS}: no such file, nor {DNERF}, {PANOPTIC}, {PAIR[0]}, {LLFF} or COLMAP's sparse/0; give a "
        f"folder that `timesplat render` wrote, or one of {LAYOUTS}."
    )


@dataclass(frozen=True)
class Arranged:
    """The Sequence in a folder before it is known where the object is."""

    world: Sequence
    matrices: list[np.ndarray] | None  # (4,4) the cameras' as they are written; None where their convention is known
    axes: str  # the convention that they are read in
    place: Callable[[np.ndarray | None], Sequence]  # the same as `open_sequence`, of `small_masks` that are known


def arranged(folder: Path, options: ReadOptions = DEFAULTS) -> Arranged:
    """Raises InputError."""
    folder = Path(folder)
    if layout := _layout(folder):
        scene = at_rate(layout.read(folder), options.fps)
        world, axes = arrange(scene, options), options.axes or scene.axes
        matrices = [p.matrix for p in scene.pictures]
        return Arranged(world, matrices, axes, lambda masks: placed(copy.deepcopy(world), scene, options, masks))
    if (folder / OURS).is_file() or not (folder / DNERF).is_file():
        seq = open_sequence(folder, options)
        return Arranged(seq, None, "opengl", lambda masks: seq)
    seq = read_dnerf(folder, options, normalised=False)
    written = None if options.axes else [v.c2w for v in seq.views]
    return Arranged(seq, written, options.axes or "opengl", lambda masks: read_dnerf(folder, options))


@lru_cache(maxsize=8)
def _assembled(folder: Path, stamps: tuple[int, ...], options: ReadOptions) -> Sequence:
    """To find the volume takes seconds, and an evaluation opens a Sequence many times."""
    layout = _layout(folder)
    assert layout is not None
    return assemble(layout.read(folder), options)


def _layout(folder: Path) -> Layout | None:
    """Of others' layouts the one that a folder has; None for ours, for D-NeRF's, and where there is nothing."""
    if (folder / OURS).is_file():
        return None if _is_ours(folder / OURS) else TRANSFORMS
    if (folder / DNERF).is_file():
        return None
    if (folder / PANOPTIC).is_file():
        return META
    if (folder / LLFF).is_file():
        return POSES
    if camera_files(folder):
        return MOCAP
    return COLMAP if model_folder(folder) else None


def _is_ours(path: Path) -> bool:
    """Whether a transforms.json is of a Sequence; also where it is damaged, which is told by who reads that."""
    try:
        d = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return True
    return not isinstance(d, dict) or "frames" not in d or str(d.get("format", "")).startswith(FORMAT)


def sequences_in(root: Path) -> list[Path]:
    """The folders of Sequences at any depth of `root`, itself included, sorted. Hidden folders are left out: a Sequence
    is rendered in one and renamed when it is whole, perhaps at this moment."""
    found = []
    for folder, below, files in os.walk(root):
        below[:] = [name for name in below if not name.startswith(".")]
        sure, perhaps = {OURS, DNERF, PANOPTIC, LLFF}, {*PAIR, *TABLES}
        if sure & {*files} or ((perhaps & {*files} or {"sparse", "colmap"} & {*below}) and _layout(Path(folder))):
            found.append(Path(folder))
            # What else lies below others' is their own: a COLMAP project beside nerfstudio's file is the same pictures.
            below[:] = [] if _layout(Path(folder)) else [n for n in below if n not in ("sparse", "colmap")]
    return sorted(found)


def described_by(folder: Path) -> list[Path]:
    """The files that say what the Sequence in a folder is; a change of it shows in them."""
    if layout := _layout(folder):
        return layout.files(folder)
    names = [OURS] if (folder / OURS).is_file() else [f"transforms_{split}.json" for split in SPLITS]
    return [folder / name for name in names if (folder / name).is_file()]


def name_of(folder: Path) -> str:
    """What a Sequence is called: ours by the folder above, which is the object's (its own is the clip's), others by
    their own."""
    folder = folder.absolute()
    return folder.parent.name if (folder / OURS).is_file() and _layout(folder) is None else folder.name
