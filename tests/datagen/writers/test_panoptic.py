# SPDX-License-Identifier: GPL-3.0-or-later
"""What Dynamic 3D Gaussians asks for, described as its train.py and helpers.py read a folder."""

import json

import numpy as np
from PIL import Image

from timesplat.datagen.writers import write_layout

from .conftest import looks_right


def test_dynamic_3d_gaussians(seq, tmp_path):
    at = tmp_path / "p"
    write_layout(seq, at, "panoptic")
    for name, cameras in (("train_meta.json", 4), ("test_meta.json", 3)):
        md = json.loads((at / name).read_text())
        assert len(md["fn"]) == 3
        for t in range(3):
            assert len(md["fn"][t]) == cameras
            for c, fn in enumerate(md["fn"][t]):
                k, w2c = np.array(md["k"][t][c]), np.array(md["w2c"][t][c])
                image = np.array(Image.open(at / "ims" / fn))
                assert image.shape == (md["h"], md["w"], 3), "it moves the channels, of which it draws three"
                mask = np.array(Image.open(at / "seg" / fn.replace(".jpg", ".png"))).astype(np.float32)
                assert mask.shape == image.shape[:2] and set(np.unique(mask)) == {0, 1}, "its values are colours"
                assert (image[mask == 0] <= 127).all(), "it renders over black"
                c2w = np.linalg.inv(w2c) @ np.diag([1, -1, -1, 1])
                looks_right(image, (k[0, 0], k[1, 1], k[0, 2], k[1, 2]), c2w, t / 2)
                place = np.linalg.inv(w2c)[:3, 3]
                assert 1 < np.linalg.norm(place) < 100, "it draws what is 1 to 100 from a camera"
    points = np.load(at / "init_pt_cld.npz")["data"]
    assert points.shape[1] == 7 and len(points) > 100
    assert (points[:, 3:6] >= 0).all() and (points[:, 3:6] <= 1).all() and (points[:, 6] == 1).all()
