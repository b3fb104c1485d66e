# SPDX-License-Identifier: GPL-3.0-or-later
"""What D-NeRF's and nerfstudio's parsers ask for. Each is described here as its source reads folders: hustvl's
4DGaussians (scene/dataset_readers.py, readNerfSyntheticInfo), nerfstudio's dnerf_dataparser and its
nerfstudio_dataparser."""

import json
import math

import numpy as np
import pytest
from PIL import Image

from timesplat.datagen.readers.lenses import Lens
from timesplat.datagen.writers import write_layout

from .conftest import SQUARE, looks_right, make


@pytest.fixture(params=["square", "off"])
def folder(request, tmp_path):
    lens = SQUARE if request.param == "square" else Lens(30, 20, 26.0, 25.0, 16.0, 9.0)
    made = make(tmp_path / "seq", lens)
    write_layout(made, tmp_path / "dnerf", "dnerf")
    write_layout(made, tmp_path / "nerfstudio", "nerfstudio")
    return tmp_path


def test_hustvls_4dgaussians(folder):
    at = folder / "dnerf"
    both = {s: json.loads((at / f"transforms_{s}.json").read_text()) for s in ("train", "test")}
    line = sorted({f["time"] for d in both.values() for f in d["frames"]})
    assert max(line) > 0, "it divides by the last time"
    for d in both.values():
        fovx = d["camera_angle_x"]
        for f in d["frames"]:
            image = Image.open(at / (f["file_path"] + ".png")).convert("RGBA")
            side = image.size[0]
            assert image.size == (side, side), "it makes pictures 800x800, and takes fovx for both sides"
            focal = side / (2 * math.tan(fovx / 2))
            matrix = np.linalg.inv(np.array(f["transform_matrix"]))
            R = -np.transpose(matrix[:3, :3])
            R[:, 0] = -R[:, 0]
            T = -matrix[:3, 3]
            w2c = np.eye(4)  # getWorld2View2(R, T), OpenCV axes
            w2c[:3, :3], w2c[:3, 3] = R.T, T
            c2w = np.linalg.inv(w2c) @ np.diag([1, -1, -1, 1])
            looks_right(image, (focal, focal, side / 2, side / 2), c2w, f["time"] / max(line))


@pytest.mark.parametrize("split", ["train", "val", "test"])
def test_nerfstudios_dnerf(folder, split):
    at = folder / "dnerf"
    meta = json.loads((at / f"transforms_{split}.json").read_text())
    names = [at / (f["file_path"].replace("./", "") + ".png") for f in meta["frames"]]
    height, width = np.asarray(Image.open(names[0])).shape[:2]  # those of all
    focal = 0.5 * width / np.tan(0.5 * float(meta["camera_angle_x"]))
    for name, f in zip(names, meta["frames"], strict=True):
        image = np.asarray(Image.open(name))
        assert image.shape == (height, width, 4)
        looks_right(
            image, (focal, focal, width / 2, height / 2), np.array(f["transform_matrix"], np.float32), f["time"]
        )


def test_nerfstudios_own(folder):
    at = folder / "nerfstudio"
    meta = json.loads((at / "transforms.json").read_text())
    assert meta["camera_model"] in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "OPENCV_FISHEYE", "EQUIRECTANGULAR")
    assert not {"k1", "k2", "k3", "p1", "p2", "fl_x", "applied_transform"} & meta.keys()
    files = [at / f["file_path"] for f in meta["frames"]]
    assert len(set(files)) == len(files)
    for split in ("train", "val", "test"):  # all three, where there is one
        listed = {at / x for x in meta[f"{split}_filenames"]}
        assert listed and listed <= set(files)
    for path, f in zip(files, meta["frames"], strict=True):
        image = np.asarray(Image.open(path))
        assert image.shape == (meta["h"], meta["w"], 4)
        looks_right(image, [f[k] for k in ("fl_x", "fl_y", "cx", "cy")], f["transform_matrix"], f["time"])


def test_without_held_out_views_nerfstudio_divides_them_itself(tmp_path):
    made = make(tmp_path / "seq", held={}, moments=2)
    write_layout(made, tmp_path / "n", "nerfstudio")
    assert not any(key.endswith("_filenames") for key in json.loads((tmp_path / "n/transforms.json").read_text()))
    write_layout(made, tmp_path / "d", "dnerf")  # whose parsers open all three
    frames = [json.loads((tmp_path / f"d/transforms_{s}.json").read_text())["frames"] for s in ("train", "val", "test")]
    assert [len(f) for f in frames] == [14, 2, 2] and len(list((tmp_path / "d").rglob("*.png"))) == 14
