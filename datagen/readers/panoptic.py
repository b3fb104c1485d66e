# SPDX-License-Identifier: GPL-3.0-or-later
"""Panoptic Studio as Dynamic 3D Gaussians has it: `train_meta.json` and `test_meta.json`, each with `w`, `h`, and for
every moment and camera `k` (3x3), `w2c` (4x4, OpenCV axes), `fn` (a path below `ims/`) and `cam_id`; masks in `seg/`.
Cameras of the second are held out. Frame numbers are those of the files' names, evenly numbered anew."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from ..sequence import InputError, read_from
from .lenses import Lens
from .posed import REMEDY, Posed, PosedScene

SPLITS = {"train_meta.json": "train", "test_meta.json": "target"}  # the rig of each
FPS = 30.0  # of the benchmark's videos


def read_panoptic(folder: Path) -> PosedScene:
    """What the two files in a folder say. Raises InputError naming the file and the fault."""
    scene = PosedScene(folder, folder / "train_meta.json", "Panoptic", [], axes="w2c-opencv", fps=FPS, counted=True)
    for name, rig in SPLITS.items():
        path = folder / name
        if not path.is_file():
            continue
        with read_from(path, REMEDY):
            d = json.loads(path.read_text(encoding="utf-8"))
            rows = list(zip(d["k"], d["w2c"], d["fn"], d["cam_id"], strict=True))
            if not rows:
                raise InputError(f"{path}: it has no frames; {REMEDY}.")
            for frame, row in enumerate(rows):
                for k, w2c, file, camera in zip(*row, strict=True):
                    K = np.array(k, float)
                    if K.shape != (3, 3) or np.shape(w2c) != (4, 4):
                        raise ValueError(f"the camera {camera} is not a 3x3 and a 4x4 matrix")
                    lens = Lens(int(d["w"]), int(d["h"]), K[0, 0], K[1, 1], K[0, 2], K[1, 2])
                    mask = f"seg/{Path(file).with_suffix('.png').as_posix()}"
                    scene.pictures.append(
                        Posed(
                            image=f"ims/{file}",
                            matrix=np.array(w2c, float),
                            lens=lens,
                            frame=float(frame),
                            camera=str(camera),
                            rig=rig,
                            mask=mask if (folder / mask).is_file() else None,
                        )
                    )
    return scene
