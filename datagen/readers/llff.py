# SPDX-License-Identifier: GPL-3.0-or-later
"""LLFF's `poses_bounds.npy`, with `images/`, or as Neural 3D Video (Neu3D, DyNeRF) has it with one video a camera.

A row a camera: 15 numbers, a 3x5 matrix by rows whose columns are the camera's axes that point down, right and
backwards, its place, and height, width and focal length in pixels; then the nearest and farthest depth, which are not
needed. The principal point is the middle.

What is held out: of Neu3D the first camera, `cam00`, as the field does (hustvl's 4DGaussians,
`neural_3D_dataset_NDC.py`: `eval_index=0`); of photographs each eighth, the first among them, as NeRF does
(`llffhold=8`).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..sequence import InputError, read_from
from .colmap import model_folder, read_points
from .lenses import Lens
from .posed import REMEDY, Posed, PosedScene
from .videos import SUFFIXES, video_of

FILE = "poses_bounds.npy"
HELD = 8  # each so many-th photograph is held out
PICTURES = (".png", ".jpg", ".jpeg", ".webp")


def read_llff(folder: Path) -> PosedScene:
    """What the file and the names of videos, or pictures, say. Raises InputError naming the file and the fault."""
    path = folder / FILE
    with read_from(path, REMEDY):
        rows = np.load(path, allow_pickle=False)
        if rows.ndim != 2 or rows.shape[1] not in (15, 17) or not len(rows):
            raise ValueError(f"it holds {'x'.join(map(str, rows.shape))} numbers, not 17 a camera")
        table = np.array(rows[:, :15], float).reshape(-1, 3, 5)
    scene = PosedScene(folder, path, "LLFF", [], upright=False)
    videos = sorted(p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES)
    folders = [] if videos else _camera_folders(folder)
    if videos:
        scene.layout, scene.counted = "Neu3D", True
        _same_number(path, len(table), len(videos), "videos")
        films = [video_of(p) for p in videos]
        scene.fps, shortest = films[0].rate, min(len(f.stamps) for f in films)
        if any(len(f.stamps) > shortest for f in films):
            scene.notes.append(f"the shortest video has {shortest} frames: of the others as many are taken")
        for k, (p, row) in enumerate(zip(videos, table, strict=True)):
            c2w, lens = _camera(row)
            rig = "train" if k else "target"
            scene.pictures += [
                Posed(f"{p.name}#{n}", c2w, lens, frame=float(n), camera=p.stem, rig=rig, video_frame=n)
                for n in range(shortest)
            ]
    elif folders:
        scene.layout, scene.counted = "Neu3D", True
        _same_number(path, len(table), len(folders), "cameras' folders")
        for k, (files, row) in enumerate(zip(folders, table, strict=True)):
            c2w, lens = _camera(row)
            camera = files[0].relative_to(folder).parts[0]
            for n, p in enumerate(files):
                name = p.relative_to(folder).as_posix()
                scene.pictures.append(
                    Posed(name, c2w, lens, frame=float(n), camera=camera, rig="train" if k else "target")
                )
    else:
        home = folder / "images"
        files = _pictures(home)
        _same_number(path, len(table), len(files), f"pictures in {home}")
        for k, (p, row) in enumerate(zip(files, table, strict=True)):
            c2w, lens = _camera(row)
            scene.pictures.append(Posed(f"images/{p.name}", c2w, lens, rig="train" if k % HELD else "target"))
    if (model := model_folder(folder)) is not None:  # of COLMAP, in whose world LLFF's cameras are
        scene.points = read_points(model)
    return scene


def _same_number(path: Path, cameras: int, found: int, what: str) -> None:
    if cameras != found:
        raise InputError(f"{path}: it has {cameras} cameras, there are {found} {what}; {REMEDY}.")


def _pictures(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in PICTURES) if folder.is_dir() else []


def _camera_folders(folder: Path) -> list[list[Path]]:
    """The frames of each camera where others took them out of the videos: `cam00/images/` or `cam00/`."""
    found = []
    for at in sorted(p for p in folder.iterdir() if p.is_dir() and p.name.startswith("cam")):
        if files := _pictures(at / "images") or _pictures(at):
            found.append(files)
    return found


def _camera(row: np.ndarray) -> tuple[np.ndarray, Lens]:
    """row (3,5) -> c2w (4,4) in OpenGL axes, and the lens."""
    down, right, back, place, (height, width, focal) = row.T
    c2w = np.eye(4)
    c2w[:3] = np.stack([right, -down, back, place], -1)
    return c2w, Lens(round(width), round(height), float(focal), float(focal), width / 2, height / 2)
