# SPDX-License-Identifier: GPL-3.0-or-later
"""The stress suite for other people's methods: Sequences out, pictures in.

`write_scenes` writes, for each condition, FOLDER/CONDITION/inputs, a Sequence, and FOLDER/CONDITION/held-out.json, the
cameras and times to be rendered. What a method makes of them goes into PICTURES/CONDITION/NAME.png, RGB or RGBA, and is
scored by `score` against the truth, which stays in the folder of the suite.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from tqdm import tqdm

from ...datagen.image_files import write_png
from ...datagen.sequence import InputError, Sequence, View, opengl_to_opencv, write_sequence
from ...datagen.zoo.trials import MOMENTS
from ...model.views import Views
from .cells import COLUMNS, Figures, keep_picture, key_of, rounded
from .measures import measured
from .scenes import Scene, held_out_sequence, load_scene, trial_folder
from .sweeps import Condition

FPS = 6.0  # of whole moments, in trials


def fingerprint(folder: Path, name: str) -> str:
    """Stands for a method that is known by its pictures alone."""
    return f"pictures {name} {folder.resolve()}"


def write_scenes(folder: Path, out: Path, conditions: Iterable[Condition], samples: int) -> int:
    """Writes the conditions, whose trials are rendered in `out`; -> how many. Raises InputError."""
    conditions = [c for c in conditions if c.seed == 0 and c.threads == 1]
    for condition in tqdm(conditions, desc="writing", unit="condition", disable=None):
        trial = trial_folder(out, condition, samples)
        scene, held_out = load_scene(trial, condition), held_out_sequence(trial)
        to_sequence(scene.inputs, folder / condition.folder / "inputs", condition)
        asked = [
            {
                "name": Path(name).stem, "time": held_out.unit_time(v.frame), "transform_matrix": v.c2w.tolist(),
                "fl_x": v.fx, "fl_y": v.fy, "cx": v.cx, "cy": v.cy,
            }
            for name, v in ((v.image, v) for v in held_out.views)
        ]  # fmt: skip
        told = {"w": held_out.width, "h": held_out.height, "background": [1, 1, 1], "frames": asked}
        (folder / condition.folder / "held-out.json").write_text(json.dumps(told, indent=1))
    return len(conditions)


def to_sequence(views: Views, folder: Path, condition: Condition) -> Sequence:
    """The views as a Sequence: pictures, cameras and times as the condition has them, no depth."""
    height, width = views.size
    c2w = opengl_to_opencv(views.c2w.double().numpy())
    moment = (views.time.double().numpy() + 1) / 2 * (MOMENTS - 1)
    seq = Sequence(width, height, FPS, 0, MOMENTS - 1, provenance={"condition": vars(condition), "asset": "stress"})
    for i, at in enumerate(moment.tolist()):
        frame = round(at) if abs(at - round(at)) < 1e-4 else at
        fx, fy, cx, cy = views.intrinsics[i].tolist()
        seq.views.append(View(frame, f"c{i:03d}", "input", c2w[i], fx, fy, cx, cy))

    def fill(root: Path) -> None:
        (root / "images").mkdir()
        rgba = (torch.cat([views.rgb, views.alpha[..., None]], -1) * 255).round().byte().numpy()
        for i, view in enumerate(seq.views):
            view.image = f"images/{i:03d}.png"
            write_png(root / view.image, rgba[i])

    return write_sequence(seq, folder, fill)


def score(pictures: Path, name: str, out: Path, conditions: Iterable[Condition], samples: int) -> dict[str, dict]:
    """Scores the pictures of a method in PICTURES/CONDITION, for each condition -> {key: row}, which are kept in
    stress.csv as well, anew each time. A condition without a folder is a failure of it. Raises InputError for pictures
    that are missing in a folder, cannot be read or have another size."""
    known, found = Figures(out).rows(), {}
    for condition in tqdm(list(conditions), desc="scoring", unit="condition", disable=None):
        key = key_of(condition, fingerprint(pictures, name), samples)
        told = {"key": key, "method": name} | vars(condition)
        folder = pictures / condition.folder
        if not folder.is_dir():
            row = told | {"failed": "no pictures"}
        else:
            scene = load_scene(trial_folder(out, condition, samples), condition)
            moments, watch = _read(folder, scene)
            figures, worst = measured(moments, watch, scene)
            keep_picture(out, key, scene.moments.picture[worst], moments[0][worst])
            row = told | rounded(figures) | {"failed": ""}
        found[key] = {c: row.get(c, "") for c in COLUMNS}
        if key not in known:
            Figures(out).add(row)
    return found


def _read(folder: Path, scene: Scene) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """Pictures over white and alpha, of `scene.moments` and of `scene.watch`; where a picture has no alpha, what is not
    white counts as shown."""
    height, width = scene.watch.views.size
    rgb, alpha = [], []
    for name in scene.names:
        path = folder / f"{Path(name).stem}.png"
        try:
            with Image.open(path) as image:
                mode, data = image.mode, np.asarray(image.convert("RGBA"))
        except FileNotFoundError:
            raise InputError(f"{path}: the picture is missing; render every view of held-out.json.") from None
        except OSError as e:
            raise InputError(f"{path}: the picture cannot be read ({e}); write it again.") from None
        if data.shape[:2] != (height, width):
            raise InputError(f"{path}: it is {data.shape[1]}x{data.shape[0]}, not {width}x{height}; render that size.")
        x = torch.from_numpy(data.astype(np.float32) / 255)
        a = x[..., 3] if "A" in mode or mode == "P" else ((x[..., :3] < 1).any(-1)).float()
        rgb.append(x[..., :3] * a[..., None] + 1 - a[..., None] if "A" in mode else x[..., :3])
        alpha.append(a)
    n = len(scene.moments.picture)
    return (torch.stack(rgb[:n]), torch.stack(alpha[:n])), (torch.stack(rgb[n:]), torch.stack(alpha[n:]))
