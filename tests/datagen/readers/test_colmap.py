# SPDX-License-Identifier: GPL-3.0-or-later
"""COLMAP's tables: models of lenses, text and binary alike, places, damage."""

import numpy as np
import pytest

from timesplat.datagen.readers.colmap import lens_of, model_folder, pose_of, read_colmap
from timesplat.datagen.sequence import InputError, opengl_to_opencv

from .worlds import PLAIN, save, shots, write_colmap, write_pictures

NAMES = [f"{k:04d}.png" for k in range(4)]


@pytest.fixture
def taken():
    return shots(4)


def test_text_and_binary_say_the_same(tmp_path, taken):
    points = [(0.5, -1.25, 3.0), (1.0, 2.0, 3.0)]
    scenes = []
    for binary in (False, True):
        folder = tmp_path / str(binary)
        write_colmap(folder, taken, NAMES, binary, points=points)
        scenes.append(read_colmap(folder))
    for scene in scenes:
        assert [p.image for p in scene.pictures] == NAMES and scene.axes == "w2c-opencv"
        assert scene.points.tolist() == [list(p) for p in points]
        for p, s in zip(scene.pictures, taken, strict=True):
            np.testing.assert_allclose(p.matrix, np.linalg.inv(opengl_to_opencv(s.c2w)), atol=1e-12)
            assert p.lens == PLAIN


def test_lens_models():
    f = [10.0, 5.0, 4.0]
    assert lens_of("SIMPLE_RADIAL", 9, 8, [*f, 0.1]).radial == (0.1,) == lens_of(2, 9, 8, [*f, 0.1]).radial
    assert lens_of("RADIAL", 9, 8, [*f, 0.1, 0.2]).radial == (0.1, 0.2)
    opencv = lens_of(4, 9, 8, [10, 11, 5, 4, 0.1, 0.2, 0.3, 0.4])
    assert (opencv.fx, opencv.fy, opencv.radial, opencv.tangential) == (10, 11, (0.1, 0.2), (0.3, 0.4))
    full = lens_of("FULL_OPENCV", 9, 8, [10, 11, 5, 4, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8])
    assert full.radial == (0.1, 0.2, 0.5) and full.divisor == (0.6, 0.7, 0.8) and full.tangential == (0.3, 0.4)
    fisheye = lens_of("OPENCV_FISHEYE", 9, 8, [10, 11, 5, 4, 0.1, 0.2, 0.3, 0.4])
    assert fisheye.fisheye and fisheye.radial == (0.1, 0.2, 0.3, 0.4)
    for model in (7, "FOV", "THIN_PRISM_FISHEYE", 99):
        with pytest.raises(InputError, match="is no lens model that is read; run COLMAP's image_undistorter"):
            lens_of(model, 9, 8, [])


def test_quaternions():
    half = np.sqrt(0.5)
    np.testing.assert_allclose(pose_of([half, 0, 0, half], [1, 2, 3]) @ [1, 0, 0, 1], [1, 3, 3, 1], atol=1e-12)
    np.testing.assert_allclose(pose_of([2, 0, 0, 0], [0, 0, 0]), np.eye(4))


def test_where_the_model_and_the_pictures_are(tmp_path, taken):
    write_colmap(tmp_path / "a", taken, NAMES)
    assert model_folder(tmp_path / "a") == tmp_path / "a" / "sparse" / "0"
    (tmp_path / "a/sparse/0").rename(tmp_path / "a/sparse/x")
    assert model_folder(tmp_path / "a") is None
    with pytest.raises(InputError, match=r"cameras\.bin: no such file, nor cameras\.txt"):
        read_colmap(tmp_path / "a")
    write_colmap(tmp_path / "b", taken, NAMES)
    write_pictures(tmp_path / "b", taken)
    save(tmp_path / "b/masks/0001.png.png", np.zeros((20, 24), np.uint8))
    save(tmp_path / "b/masks/0002.png", np.zeros((20, 24), np.uint8))
    scene = read_colmap(tmp_path / "b")
    assert [p.image for p in scene.pictures] == [f"images/{n}" for n in NAMES]
    assert [p.mask for p in scene.pictures] == [None, "masks/0001.png.png", "masks/0002.png", None]


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_files_that_end_too_early(tmp_path, taken, name):
    write_colmap(tmp_path, taken, NAMES, binary=True, points=[(0, 0, 0)])
    path = tmp_path / "sparse/0" / name
    whole = path.read_bytes()
    for size in (0, 5, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:size])
        with pytest.raises(InputError, match=rf"{name}: it is damaged \(it ends too early\)"):
            read_colmap(tmp_path)


def test_damage_is_named(tmp_path, taken):
    write_colmap(tmp_path, taken, NAMES)
    at = tmp_path / "sparse/0"
    good = {n: (at / n).read_text() for n in ("cameras.txt", "images.txt")}
    for name, text, says in (
        ("cameras.txt", "1 FOV 24 20 1 2 3\n", r"cameras\.txt: FOV is no lens model"),
        ("cameras.txt", "1 PINHOLE 24 20 1 2 3\n", r"cameras\.txt: it is damaged"),
        ("cameras.txt", "2 PINHOLE 24 20 1 2 3 4\n", r"0000\.png has the camera 1, which cameras\.txt lacks"),
        ("images.txt", "1 0.5 0.5 x\n\n", r"images\.txt: it is damaged"),
        ("images.txt", "1 0.5 0.5\n\n", r"images\.txt: it is damaged"),
    ):
        (at / name).write_text(text)
        with pytest.raises(InputError, match=says):
            read_colmap(tmp_path)
        (at / name).write_text(good[name])
    assert len(read_colmap(tmp_path).pictures) == 4
