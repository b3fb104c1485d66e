# SPDX-License-Identifier: GPL-3.0-or-later
"""Panoptic, as Dynamic 3D Gaussians reads it: `train_meta.json`, `test_meta.json`, `ims/`, `seg/`, `init_pt_cld.npz`.

Its pictures have three channels, over black, which is what it renders over; masks are 0 and 1. Moments are numbered
one after another, cameras too. What is held out is in the second file.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from ..sequence import Sequence, opengl_to_opencv
from .pictures import Progress, camera_names
from .points import start_points


def write_panoptic(seq: Sequence, folder: Path, progress: Progress) -> None:
    """Into an empty folder. Raises InputError for a picture that cannot be read."""
    from PIL import Image

    moments = {f: n for n, f in enumerate(sorted({v.frame for v in seq.views}))}
    who = [(v.held_out, name) for v, name in zip(seq.views, camera_names(seq), strict=True)]
    cameras = {w: n for n, w in enumerate(dict.fromkeys(who))}
    files: dict[str, dict] = {}
    for name in ("train_meta.json", "test_meta.json"):
        empty: dict[str, list] = {key: [[] for _ in moments] for key in ("k", "w2c", "fn", "cam_id")}
        files[name] = {"w": seq.width, "h": seq.height, **empty}
    for i, v in enumerate(seq.views):
        progress(i / len(seq.views), "writing pictures")
        held, moment, number = who[i][0], moments[v.frame], cameras[who[i]]
        name = f"{number}/{moment:06d}.png"
        rgba = seq.load_image(i)
        share = rgba[..., 3:].astype(np.float32) / 255
        rgb, mask = np.rint(rgba[..., :3] * share).astype(np.uint8), (rgba[..., 3] > 127).astype(np.uint8)
        for home, picture in (("ims", rgb), ("seg", mask)):
            (folder / home / str(number)).mkdir(parents=True, exist_ok=True)
            Image.fromarray(picture).save(folder / home / name)
        d = files["test_meta.json" if held else "train_meta.json"]
        d["k"][moment].append([[v.fx, 0.0, v.cx], [0.0, v.fy, v.cy], [0.0, 0.0, 1.0]])
        d["w2c"][moment].append(np.linalg.inv(opengl_to_opencv(v.c2w)).tolist())
        d["fn"][moment].append(name)
        d["cam_id"][moment].append(number)
    for name, d in files.items():
        if any(d["fn"]):
            (folder / name).write_text(json.dumps(d))
    points, colours = start_points(seq)
    data = np.concatenate([points, colours / 255, np.ones((len(points), 1))], 1)
    np.savez(folder / "init_pt_cld.npz", data=data)
