# SPDX-License-Identifier: GPL-3.0-or-later
"""`transforms.json` as nerfstudio, instant-ngp and those who follow them write it.

Lenses (`fl_x` … `cy`, `w`, `h`, `k1` … `k4`, `p1`, `p2`, `camera_model`, or `camera_angle_x` alone) stand at the top,
or in a frame, which then counts. `transform_matrix` is camera-to-world with OpenGL axes, 4x4 or 3x4;
`applied_transform` and `applied_scale`, which say how its world came out of another program's, are kept. Moments:
`time`, `frame`; splits: `train_filenames` and its like, or `rig`. What instant-ngp lists and does not have it leaves
out, as that program does.
"""

from __future__ import annotations

import json
import math
from pathlib import Path, PurePosixPath

import numpy as np

from ..sequence import InputError, read_from
from .lenses import Lens
from .pictures import size_of
from .posed import REMEDY, Posed, PosedScene

MODELS = {"OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV_FISHEYE"}
SPLITS = {"train_filenames": "train", "val_filenames": "val", "test_filenames": "target"}
SUFFIXES = ("", ".png", ".jpg", ".jpeg")  # that are tried, in this order


def read_transforms(folder: Path) -> PosedScene:
    """What `transforms.json` in a folder says. Raises InputError naming the file and the fault."""
    path = folder / "transforms.json"
    with read_from(path, REMEDY):
        d = json.loads(path.read_text(encoding="utf-8"))
        frames = d["frames"]
        if not frames:
            raise InputError(f"{path}: it has no frames; {REMEDY}.")
        maker = "instant-ngp" if "aabb_scale" in d else "nerfstudio"
        scene = PosedScene(folder, path, maker, [])
        if maker == "instant-ngp":
            there = [f for f in frames if (folder / _picture(folder, str(f["file_path"]))).is_file()]
            if there and len(there) < len(frames):
                scene.notes.append(f"{len(frames) - len(there)} pictures that it lists are not there and left out")
                frames = there
        rigs = _rigs(d)
        for f in frames:
            scene.pictures.append(_posed(folder, path, d | f, rigs))
        scene.fps = float(d["fps"]) if d.get("fps") else None
        range_ = [d.get(k) for k in ("frame_start", "frame_end")]
        scene.frame_range = (
            None if range_[0] is None else int(range_[0]),
            None if range_[1] is None else int(range_[1]),
        )
        kept = {k: d[k] for k in ("applied_transform", "applied_scale") if k in d}
        if kept:
            scene.provenance = kept
        return scene


def matrix_of(rows) -> np.ndarray:
    """A 4x4 matrix of one that is 4x4 or 3x4. Raises ValueError for other shapes."""
    m = np.array(rows, dtype=np.float64)
    if m.shape == (3, 4):
        m = np.concatenate([m, [[0.0, 0.0, 0.0, 1.0]]])
    if m.shape != (4, 4):
        raise ValueError(f"a camera's matrix is {'x'.join(map(str, m.shape))}, not 4x4 or 3x4")
    return m


def _posed(folder: Path, path: Path, f: dict, rigs: dict[str, str]) -> Posed:
    name = str(f["file_path"])
    image = _picture(folder, name)
    mask = f.get("mask_path")
    if mask and not (folder / mask).is_file():
        raise InputError(f"{folder / mask}: the mask is missing; {REMEDY}.")
    return Posed(
        image=image,
        matrix=matrix_of(f["transform_matrix"]),
        lens=_lens(folder / image, path, f),
        time=None if f.get("time") is None else float(f["time"]),
        frame=None if f.get("frame") is None else float(f["frame"]),
        camera=None if f.get("camera") is None else str(f["camera"]),
        rig=str(f.get("rig") or rigs.get(str(PurePosixPath(name)), "train")),
        mask=str(PurePosixPath(mask)) if mask else None,
    )


def _lens(image: Path, path: Path, f: dict) -> Lens:
    model = str(f.get("camera_model", "OPENCV")).upper()
    if model not in MODELS:
        raise InputError(
            f"{path}: {model} is no lens model that is read; undistort the pictures first, or give one of "
            f"{', '.join(sorted(MODELS))}."
        )
    if "w" in f and "h" in f:
        width, height = int(f["w"]), int(f["h"])
    else:
        (width, height), _, _ = size_of(image, True, REMEDY)
    if "fl_x" in f:
        fx = float(f["fl_x"])
        fy = float(f.get("fl_y", fx))
    else:
        fx = _focal(f, "camera_angle_x", width)
        fy = _focal(f, "camera_angle_y", height) if "camera_angle_y" in f else fx
    k = tuple(float(f.get(name, 0.0)) for name in ("k1", "k2", "k3", "k4"))
    p = float(f.get("p1", 0.0)), float(f.get("p2", 0.0))
    fisheye = model == "OPENCV_FISHEYE" or bool(f.get("is_fisheye"))
    pinhole = model.endswith("PINHOLE")
    return Lens(
        width, height, fx, fy, float(f.get("cx", width / 2)), float(f.get("cy", height / 2)),
        radial=k if any(k) and not pinhole else (),
        tangential=(0.0, 0.0) if fisheye or pinhole else p,
        fisheye=fisheye,
    )  # fmt: skip


def _focal(f: dict, key: str, size: int) -> float:
    """Pixels, of an angle in radians. Raises KeyError where it is not there."""
    return size / 2 / math.tan(float(f[key]) / 2)


def _picture(folder: Path, name: str) -> str:
    """The path below the folder of what a file calls `name`, which may lack its suffix."""
    names = [f"{PurePosixPath(name)}{suffix}" for suffix in SUFFIXES]
    return next((n for n in names if (folder / n).is_file()), names[0])


def _rigs(d: dict) -> dict[str, str]:
    """The rig of each picture that a split names."""
    return {str(PurePosixPath(name)): rig for key, rig in SPLITS.items() for name in d.get(key, [])}
