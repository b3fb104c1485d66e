# SPDX-License-Identifier: GPL-3.0-or-later
"""Scenes in the format of D-NeRF and of NeRF's synthetic scenes, as Sequences.

transforms_train.json, and transforms_val.json and transforms_test.json where there are, each with `camera_angle_x` and
`frames` of `file_path` (without suffix), `transform_matrix` (camera-to-world, OpenGL axes) and, where things move,
`time` 0..1. The splits become rigs: train, val, and test as what is held out, the rig target.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np

from ..sequence import (
    HELD_OUT,
    InputError,
    Normalisation,
    Sequence,
    View,
    check_sequence,
    focal_lengths,
    frame_number,
    read_from,
)
from .lenses import Lens
from .options import AXES, ReadOptions
from .pictures import Pictures, Source, background_of, size_of
from .volume import normalisation_of_views

SPLITS = {"train": "train"} | HELD_OUT  # the rig of each
FPS = 24.0  # the format has no rate
SUFFIXES = ("", ".png")  # that are tried, in this order
REMEDY = "correct it, or get the data set again"
FOUND_OUT = ReadOptions()
SNAP = 1e-3  # frames: as much rounding of a printed time is taken back


def read_dnerf(folder: Path, options: ReadOptions = FOUND_OUT, normalised: bool = True) -> Sequence:
    """Reads and checks the scene in a folder; pictures are read later, but that they exist is checked now. Its clip has
    as many frames as there are distinct times of train views; times between them are fractions of a frame. It is
    normalised by its cameras, see `normalisation_of`, unless it shall not be. Pictures without alpha have a background,
    measured or told.

    Raises InputError naming the file and the fault: missing or damaged JSON, no camera_angle_x, a missing picture, a
    camera that is not a rigid finite transform, a time that is not within 0..1, cameras that do not look at one place.
    """
    folder = Path(folder)
    files = {split: folder / f"transforms_{split}.json" for split in SPLITS}
    if not files["train"].is_file():
        raise InputError(f"{files['train']}: no such file; give a folder in the format of D-NeRF.")
    data = {split: _load(path) for split, path in files.items() if path.is_file()}
    with read_from(files["train"], REMEDY):
        moving = any("time" in f for f in data["train"]["frames"])
        width, height = _size(folder, data["train"])
        times = {round(float(f["time"]), 6) for f in data["train"]["frames"]} if moving else {0.0}
    seq = Sequence(width, height, options.fps or FPS, 0, max(len(times) - 1, 0), root=folder, remedy=REMEDY)
    seq.provenance = {
        "asset": folder.absolute().name,
        "format": "D-NeRF",
        "fps": "as --fps says" if options.fps else f"not known, {FPS:g} assumed",
    }
    # What several files list is of the first of these; ours does so where a split would be empty.
    owner = {f["file_path"]: s for s in ("val", "test", "train") if s in data for f in data[s]["frames"]}
    for split, d in data.items():
        with read_from(files[split], REMEDY):
            d["frames"] = [f for f in d["frames"] if owner[f["file_path"]] == split]
            views = [_view(seq, split, n, d, f, moving) for n, f in enumerate(d["frames"])]
            for v in views:
                v.c2w = AXES[options.axes or "opengl"](v.c2w)
        if views:
            check_sequence(replace(seq, views=views), files[split])
        seq.views += views
    if normalised:
        seq.normalisation = normalisation_of([v for v in seq.views if v.rig == "train"], width, height, files["train"])
        for v in seq.views:
            v.c2w = seq.normalisation.from_world(v.c2w)
    told = "alpha says what is the object"
    if not size_of(folder / seq.views[0].image, True, REMEDY)[2]:
        lenses = {v.image: Lens(width, height, v.fx, v.fy, v.cx, v.cy) for v in seq.views}
        sources = {name: Source(folder / name, None, lens) for name, lens in lenses.items()}
        background, told = background_of(list(sources.values()), False, False, options.background, REMEDY)
        seq.picture = Pictures(sources, background, False, REMEDY)
    seq.provenance["read"] = ["D-NeRF", told, "volume: what the cameras look at together"]
    return seq


def normalisation_of(views: list[View], width: int, height: int, path: Path) -> Normalisation:
    """What leads from the unit box back to the world of some views' cameras: the origin is the point nearest to all of
    their optical axes, by least squares, and of a plane there the median camera sees 1 to the sides, up and down
    (whichever is less). Raises InputError naming `path` where the axes are parallel, or meet behind the cameras."""
    place = np.array([v.c2w[:3, 3] for v in views])
    axis = np.array([-v.c2w[:3, 2] for v in views])
    slope = np.array([min(width / v.fx, height / v.fy) / 2 for v in views])
    return normalisation_of_views(place, axis, slope, path)


def _load(path: Path) -> dict:
    with read_from(path, REMEDY):
        d = json.loads(path.read_text(encoding="utf-8"))
        if not d["frames"]:
            raise InputError(f"{path}: it has no frames; {REMEDY}.")
        return d


def _picture(folder: Path, name: str) -> str:
    """The path below the folder of the picture that a file calls `name`; with the last suffix where there is none."""
    names = [f"{PurePosixPath(name)}{suffix}" for suffix in SUFFIXES]
    return next((n for n in names if (folder / n).is_file()), names[-1])


def _size(folder: Path, d: dict) -> tuple[int, int]:
    """Width and height, as stated or as the first picture has it."""
    from PIL import Image

    if "w" in d and "h" in d:
        return int(d["w"]), int(d["h"])
    path = folder / _picture(folder, d["frames"][0]["file_path"])
    try:
        with Image.open(path) as im:
            return im.size
    except FileNotFoundError:
        raise InputError(f"{path}: the file is missing; {REMEDY}.") from None
    except Exception as e:
        raise InputError(f"{path}: the image cannot be read ({e}); {REMEDY}.") from None


def _view(seq: Sequence, split: str, number: int, d: dict, f: dict, moving: bool) -> View:
    name = str(f["file_path"])
    time = float(f["time"]) if moving else 0.0
    if not 0 <= time <= 1:
        raise ValueError(f"the time of {name} is not within 0..1")
    frame = frame_number(time * seq.frame_end)
    if abs(frame - round(frame)) < SNAP:
        frame = round(frame)
    fx, fy = focal_lengths(d | f, seq.width)
    return View(
        frame=frame,
        camera=f"{split}-{number:03d}",
        rig=SPLITS[split],
        c2w=np.array(f["transform_matrix"], dtype=np.float64),
        fx=fx,
        fy=fy,
        cx=float((d | f).get("cx", seq.width / 2)),
        cy=float((d | f).get("cy", seq.height / 2)),
        image=_picture(seq.folder, name),
    )
