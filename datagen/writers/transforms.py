# SPDX-License-Identifier: GPL-3.0-or-later
"""D-NeRF's and nerfstudio's JSON.

dnerf: `transforms_{train,val,test}.json` with `camera_angle_x`, and of each frame `file_path` without `.png`, `time`
0..1 and `transform_matrix`. Its parsers know one focal length, square pictures (hustvl's 4DGaussians makes them
800x800) and the principal point in the middle: views that are otherwise are taken anew by such a camera.
nerfstudio: `transforms.json` with the inside of each camera, and the splits where anything is held out.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

from ..sequence import Sequence, View
from .pictures import Progress, Square, camera_names, frame_names, put, splits_of


def write_dnerf(seq: Sequence, folder: Path, progress: Progress) -> None:
    """Into an empty folder. Raises InputError for a picture that cannot be read."""
    square = Square.around(seq)
    angle = 2 * math.atan(square.side / 2 / square.focal)
    done: dict[int, str] = {}
    for split, views in splits_of(seq).items():
        (folder / split).mkdir()
        frames = []
        for n, i in enumerate(views):
            if i not in done:  # what two splits list is there once
                progress(len(done) / len(seq.views), "writing pictures")
                done[i] = f"./{split}/r_{n:04d}"
                square.put(seq, i, folder / f"{done[i]}.png")
            v = seq.views[i]
            frames.append({"file_path": done[i], "time": seq.unit_time(v.frame), "transform_matrix": v.c2w.tolist()})
        d = {"camera_angle_x": angle, "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(d, indent=1))


def write_nerfstudio(seq: Sequence, folder: Path, progress: Progress) -> None:
    """Into an empty folder. Raises InputError for a picture that cannot be read."""
    (folder / "images").mkdir()
    moments, cameras = frame_names(seq), camera_names(seq)
    names = [f"images/{moments[v.frame]}_{c}.png" for v, c in zip(seq.views, cameras, strict=True)]
    for i, name in enumerate(names):
        progress(i / len(names), "writing pictures")
        put(seq, i, folder / name)
    write_transforms(seq, folder, names)


def write_transforms(seq: Sequence, folder: Path, names: list[str]) -> None:
    """`transforms.json` of pictures that are called `names`, below the folder."""
    d = {
        "camera_model": "OPENCV",
        "w": seq.width,
        "h": seq.height,
        "fps": seq.fps,
        "frame_start": seq.frame_start,
        "frame_end": seq.frame_end,
        "frames": [_frame(seq, v, name) for v, name in zip(seq.views, names, strict=True)],
    }
    if any(seq.select(rig=rig) for rig in ("val", "target")):
        d |= {f"{split}_filenames": [names[i] for i in views] for split, views in splits_of(seq).items()}
    (folder / "transforms.json").write_text(json.dumps(d, indent=1))


def _frame(seq: Sequence, v: View, name: str) -> dict:
    return {
        "file_path": name,
        "fl_x": v.fx,
        "fl_y": v.fy,
        "cx": v.cx,
        "cy": v.cy,
        "transform_matrix": v.c2w.tolist(),
        "camera": v.camera,
        "rig": v.rig,
        # All times the same would be taken for a mistake.
        **({"time": seq.unit_time(v.frame), "frame": v.frame} if seq.frame_end > seq.frame_start else {}),
    }
