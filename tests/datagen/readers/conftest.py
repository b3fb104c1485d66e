"""Scenes in the format of D-NeRF that the tests of readers share."""

import json

import numpy as np
import pytest

from timesplat.datagen import image_files, rigs
from timesplat.datagen.sequence import focal_from_fov

SIZE = (6, 4)
SPLITS = {"train": 12, "val": 2, "test": 3}  # views of each


@pytest.fixture
def write_dnerf(tmp_path):
    """write_dnerf(name, scale=1, offset=0, moving=True) -> the folder of a scene of 12 train views around the point
    `offset` in every direction, 2.7 * scale from it, at the times k/11; those of val and test at thirds."""

    def write(name="scene", scale=1.0, offset=0.0, moving=True):
        folder, rng = tmp_path / name, np.random.default_rng(0)
        for split, count in SPLITS.items():
            (folder / split).mkdir(parents=True)
            frames = []
            for k in range(count):
                c2w = rigs.spherical(37 * k + len(split), 50 * np.sin(k))
                c2w[:3, 3] = scale * c2w[:3, 3] + offset
                f = {"file_path": f"./{split}/r_{k:03d}", "rotation": 0.1, "transform_matrix": c2w.tolist()}
                if moving:
                    f["time"] = k / 11 if split == "train" else k / 3
                picture = rng.integers(0, 256, (SIZE[1], SIZE[0], 4), np.uint8)
                image_files.write_png(folder / split / f"r_{k:03d}.png", picture)
                frames.append(f)
            angle = 2 * np.arctan(SIZE[0] / 2 / focal_from_fov(50, SIZE[1]))
            (folder / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))
        return folder

    return write
