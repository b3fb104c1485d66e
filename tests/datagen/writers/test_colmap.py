# SPDX-License-Identifier: GPL-3.0-or-later
"""What readers of COLMAP's text ask for, described as 3DGS's (colmap_loader.py) and hustvl's 4DGaussians' source reads
it; and every frame in a folder of its own."""

import numpy as np
import pytest
from PIL import Image

from timesplat.datagen.readers import open_sequence
from timesplat.datagen.readers.colmap import pose_of
from timesplat.datagen.readers.options import ReadOptions
from timesplat.datagen.writers import write_layout
from timesplat.datagen.writers.colmap import quaternion_of

from .conftest import looks_right


def read_text(model):
    """Cameras {id: (model, w, h, params)}, images [(id, qvec, tvec, camera, name)] and points (P,6), as 3DGS does."""
    lines = lambda name: [x.strip() for x in (model / name).read_text().splitlines()]  # noqa: E731
    cameras, images, points = {}, [], []
    for line in lines("cameras.txt"):
        if line and line[0] != "#":
            n, kind, w, h, *params = line.split()
            assert kind == "PINHOLE", "others are said to be distorted"
            cameras[int(n)] = (kind, int(w), int(h), np.array(tuple(map(float, params))))
    left = iter(lines("images.txt"))
    for line in left:
        if line and line[0] != "#":
            e = line.split()
            images.append((int(e[0]), np.array(e[1:5], float), np.array(e[5:8], float), int(e[8]), e[9]))
            elems = next(left).split()
            assert len(elems) % 3 == 0
    for line in lines("points3D.txt"):
        if line and line[0] != "#":
            e = line.split()
            points.append([*map(float, e[1:4]), *map(int, e[4:7])])
            float(e[7])  # its error
    return cameras, images, np.array(points)


def check(model, pictures, time):
    cameras, images, points = read_text(model)
    for _, qvec, tvec, camera, name in images:
        _, w, h, params = cameras[camera]
        image = Image.open(pictures / name.split("/")[-1])  # the last part of the name alone
        assert image.size == (w, h)
        w2c = pose_of(list(qvec), list(tvec))
        looks_right(image, params, np.linalg.inv(w2c) @ np.diag([1, -1, -1, 1]), time(name))
    assert len(points) > 100 and np.abs(points[:, :3]).max() < 1.5 and points[:, 3:].max() <= 255
    return images


def test_the_whole_clip(seq, tmp_path):
    write_layout(seq, tmp_path / "c", "colmap")
    images = check(tmp_path / "c/sparse/0", tmp_path / "c/images", lambda name: int(name.split("_")[1]) / 2)
    names = [name for *_, name in images]
    assert len(set(names)) == 21 and names[0] == "frame_0000_cam0.png"


def test_every_frame_by_itself(seq, tmp_path):
    write_layout(seq, tmp_path / "f", "frames")
    for m in range(3):
        home = tmp_path / f"f/frame_{m:04d}"
        assert len(check(home / "sparse/0", home / "images", lambda _, m=m: m / 2)) == 7
        assert sorted(p.name for p in home.iterdir()) == ["images", "sparse"]
        alone = open_sequence(home, ReadOptions(times="none"))
        assert len(alone.views) == 7 and alone.frame_end == 0


def test_quaternions():
    rng = np.random.default_rng(0)
    turns = [np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(20)]
    for R in [np.diag([1.0, -1, -1]), np.diag([-1.0, 1, -1]), np.eye(3), *turns]:
        R = R * np.sign(np.linalg.det(R))
        q = quaternion_of(R)
        assert q[0] >= 0 and np.linalg.norm(q) == pytest.approx(1)
        np.testing.assert_allclose(pose_of(list(q), [0, 0, 0])[:3, :3], R, atol=1e-12)
