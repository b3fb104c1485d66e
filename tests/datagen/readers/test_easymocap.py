# SPDX-License-Identifier: GPL-3.0-or-later
"""EasyMocap and ZJU-MoCap: cameras in OpenCV's YAML, as JSON and in annots.npy; folders of pictures, and videos."""

import json
from dataclasses import replace

import numpy as np
import pytest

from timesplat.datagen.readers import open_sequence, sequences_in
from timesplat.datagen.readers.easymocap import file_storage, read_easymocap, rotation_of
from timesplat.datagen.sequence import InputError

from .worlds import PLAIN, on_white, photograph, save

pytest.importorskip("av", reason="needs timesplat[video]")

from .filmed import calibration, film, rig


@pytest.fixture(scope="module")
def films():
    return rig(8, 3)


def matrix(name, x):
    x = np.atleast_2d(x)
    numbers = ", ".join(f"{v:.12e}" if k % 2 else repr(float(v)) for k, v in enumerate(x.ravel()))
    data = numbers.replace(", ", ",\n       ", 1)  # OpenCV breaks long lines
    return f"{name}: !!opencv-matrix\n   rows: {x.shape[0]}\n   cols: {x.shape[1]}\n   dt: d\n   data: [ {data} ]\n"


def vector_of(R):
    angle = np.arccos((np.trace(R) - 1) / 2)
    return angle / (2 * np.sin(angle)) * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])


def write_yaml(folder, cameras, vectors=False, sizes=True):
    names = "%YAML:1.0\n---\nnames:\n" + "".join(f'  - "{n}"\n' for n in cameras)
    inside, outside = names, names
    for n, c in cameras.items():
        inside += matrix(f"K_{n}", c["K"]) + matrix(f"dist_{n}", c["D"])
        if sizes:
            inside += f"H_{n}: {c['H']}\nW_{n}: {c['W']}\n"
        outside += matrix(f"R_{n}", vector_of(c["R"])[:, None]) + matrix(f"T_{n}", c["T"])
        if not vectors:
            outside += matrix(f"Rot_{n}", c["R"])
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "intri.yml").write_text(inside)
    (folder / "extri.yml").write_text(outside)


def write_pictures(folder, films, name="images/{}/{:06d}.png", mask=None, step=1):
    for shots in films:
        for n, s in enumerate(shots):
            rgba = photograph(s)
            save(folder / name.format(s.camera, step * n), rgba[..., :3] if mask else rgba)
            if mask:
                save(folder / mask.format(s.camera, step * n), (rgba[..., 3] > 127).astype(np.uint8) * 3)


def same(seq, films):
    assert len(seq.views) == sum(map(len, films)) and seq.provenance["format"] == "EasyMocap"
    for k, v in enumerate(seq.views):
        s = films[int(v.camera)][v.frame]
        np.testing.assert_allclose(seq.normalisation.to_world(v.c2w), s.c2w, atol=1e-8)
        assert (v.fx, v.fy, v.cx, v.cy) == pytest.approx((PLAIN.fx, PLAIN.fy, PLAIN.cx, PLAIN.cy), abs=1e-9)
        assert np.abs(on_white(seq.load_image(k)).astype(int) - on_white(photograph(s))).mean() < 8
    return seq


@pytest.mark.parametrize(("vectors", "sizes"), [(False, True), (True, False)])
def test_opencvs_yaml(tmp_path, films, vectors, sizes):
    write_yaml(tmp_path, calibration(films), vectors, sizes)
    write_pictures(tmp_path, films, step=5)
    seq = same(open_sequence(tmp_path), films)
    assert seq.frame_end == 2 and sequences_in(tmp_path) == [tmp_path]


def test_videos(tmp_path, films):
    write_yaml(tmp_path, calibration(films), sizes=False)
    film(tmp_path, films, "videos/{}.mp4", rate=50)
    assert same(open_sequence(tmp_path), films).fps == 50


@pytest.mark.parametrize("name", ["cameras.json", "calibration.json"])
def test_json_by_name(tmp_path, films, name):
    cameras = {n: {k: np.array(x).tolist() for k, x in c.items()} for n, c in calibration(films).items()}
    (tmp_path / name).write_text(json.dumps(cameras))
    write_pictures(tmp_path, films, "{}/{:04d}.jpg", "mask/{}/{:04d}.png")
    same(open_sequence(tmp_path), films)


@pytest.mark.parametrize("name", ["annots.npy", "annots.json"])
def test_zju(tmp_path, films, name):
    """Lists beside the names of pictures, masks that hold the numbers of parts."""
    c = calibration(films)
    d = {"cams": {k: [x[k].tolist() if name.endswith("json") else x[k] for x in c.values()] for k in "KRTD"}}
    d["ims"] = [{"ims": [f"Camera_B{n}/{m:06d}.jpg" for n in c], "kpts2d": []} for m in range(3)]
    if name.endswith("npy"):
        np.save(tmp_path / name, d, allow_pickle=True)
    else:
        (tmp_path / name).write_text(json.dumps(d))
    write_pictures(tmp_path, films, "Camera_B{}/{:06d}.jpg", "mask_cihp/Camera_B{}/{:06d}.png")
    seq = open_sequence(tmp_path)
    for v in seq.views:
        v.camera = v.camera.removeprefix("Camera_B")
    same(seq, films)
    assert "masks say what is the object" in seq.provenance["read"]


def test_distortion_is_opencvs(films, tmp_path):
    bent = replace(PLAIN, radial=(0.2, -0.1, 0.05), tangential=(0.01, -0.02))
    write_yaml(tmp_path, calibration(rig(3, 1, bent)))
    for n in ("00", "01", "02"):
        save(tmp_path / f"images/{n}/0.png", np.zeros((20, 24, 4), np.uint8))
    for p in read_easymocap(tmp_path).pictures:
        assert p.lens == bent


def test_rotation_vectors():
    np.testing.assert_allclose(rotation_of(np.array([0, 0, np.pi / 2])), [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-15)
    assert (rotation_of(np.zeros(3)) == np.eye(3)).all()
    for seed in range(5):
        R = rotation_of(np.random.default_rng(seed).normal(size=3))
        np.testing.assert_allclose(rotation_of(vector_of(R)), R, atol=1e-12)


def test_file_storage():
    text = "%YAML:1.0\n---\nH_1: 20\na: !!opencv-matrix\n   rows: 1\n   cols: 2\n   dt: f\n   data: [ 1., -2.5e-01 ]\n"
    found = file_storage(text)
    assert found["H_1"] == 20 and found["a"].tolist() == [[1, -0.25]]
    with pytest.raises(ValueError):
        file_storage(text.replace("cols: 2", "cols: 3"))


def test_another_programs_cameras_json_is_left_alone(tmp_path):
    for content in ('[{"id": 0, "img_name": "a"}]', "{}", "no json"):
        (tmp_path / "cameras.json").write_text(content)
        assert sequences_in(tmp_path) == []


def test_damage_is_named(tmp_path, films):
    c = calibration(films)
    write_yaml(tmp_path, c)
    with pytest.raises(InputError, match="images: no pictures and no videos of the cameras 00, 01, 02"):
        read_easymocap(tmp_path)
    write_pictures(tmp_path, films)
    (tmp_path / "images/04").rename(tmp_path / "gone")
    assert "1 cameras have no pictures and are left out: 04" in read_easymocap(tmp_path).notes
    good = (tmp_path / "extri.yml").read_text()
    (tmp_path / "extri.yml").write_text(good.replace("T_03", "X_03"))
    with pytest.raises(InputError, match=r"extri\.yml: the camera 03 has no R_03 and T_03"):
        read_easymocap(tmp_path)
    for change, says in (
        ({"D": np.zeros(6)}, "the camera 00 has 6 numbers of distortion"),
        ({"K": np.zeros((2, 3))}, r"the camera 00 has a K of \(2, 3\)"),
        ({"T": np.zeros(4)}, r"the camera 00 has an R of \(3, 3\) and a T of \(4,\)"),
    ):
        write_yaml(tmp_path, c | {"00": c["00"] | change})
        with pytest.raises(InputError, match=rf"intri\.yml: it is damaged \({says}"):
            read_easymocap(tmp_path)
