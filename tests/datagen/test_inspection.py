# SPDX-License-Identifier: GPL-3.0-or-later
"""What is said of folders: of right ones that they are, of wrong ones what to pass."""

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from timesplat.cli import main
from timesplat.datagen.inspection import counts, coverage, inspect, light, lying, repeated
from timesplat.datagen.readers import placing
from timesplat.datagen.readers.options import ReadOptions
from timesplat.datagen.sequence import InputError, Sequence, View, opengl_to_opencv

from .readers.worlds import save, shots, write_panoptic, write_pictures, write_transforms

FLIP = np.diag([1, 1, -1, 1])
WRITTEN = {
    "opencv": opengl_to_opencv,
    "left-handed": lambda m: FLIP @ m @ FLIP,
    "w2c-opengl": np.linalg.inv,
    "w2c-opencv": lambda m: np.linalg.inv(opengl_to_opencv(m)),
}


@pytest.fixture(scope="module")
def taken():
    return shots(16, moving=False)


def test_of_a_right_one(tmp_path, taken):
    write_pictures(tmp_path, taken)
    found = inspect(write_transforms(tmp_path, taken, frame=lambda k, s: {"time": None}), ReadOptions())
    assert found.counts == "nerfstudio: 16 pictures by 16 cameras of 1 moment, 24x20 pixels" and found.placed
    assert found.agreement.startswith("the cameras agree: ") and found.advice is None and found.warnings == []
    share = float(found.agreement.split("agree: ")[1].split("%")[0])
    assert share > 90 and "alpha says what is the object" in found.lines


@pytest.mark.parametrize("axes", WRITTEN)
def test_the_axes_that_fit_are_told(tmp_path, taken, axes):
    """Whatever convention the cameras are written in: the sentence names it, and then it fits."""
    write_pictures(tmp_path, taken)
    how = {"time": None}
    write_transforms(tmp_path, taken, frame=lambda k, s: how | {"transform_matrix": WRITTEN[axes](s.c2w).tolist()})
    found = inspect(tmp_path, ReadOptions())
    assert found.advice and f"pass --axes {axes}" in found.advice and not found.placed
    assert not any("for its cameras" in x for x in found.lines), (
        "how cameras lie that are read wrongly is nothing to say"
    )
    again = inspect(tmp_path, ReadOptions(axes=axes))
    assert again.advice is None and again.placed and "agree" in again.agreement


def test_of_d_nerf_too(tmp_path, taken):
    write_pictures(tmp_path, taken, name="train/{k:04d}.png")
    write_transforms(tmp_path, taken, frame=lambda k, s: {"file_path": f"train/{k:04d}", "time": k / 15})
    d = json.loads((tmp_path / "transforms.json").read_text())
    (tmp_path / "transforms.json").unlink()
    (tmp_path / "transforms_train.json").write_text(json.dumps(d))
    assert inspect(tmp_path, ReadOptions()).advice is None
    for f in d["frames"]:
        f["transform_matrix"] = np.linalg.inv(f["transform_matrix"]).tolist()
    (tmp_path / "transforms_train.json").write_text(json.dumps(d))
    assert "pass --axes w2c-opengl" in inspect(tmp_path, ReadOptions()).advice
    assert inspect(tmp_path, ReadOptions(axes="w2c-opengl")).placed


@pytest.mark.parametrize("wrong", [False, True])
def test_silhouettes_are_cut_out_once(tmp_path, taken, monkeypatch, wrong):
    """They are most of the time that it takes."""
    write_pictures(tmp_path, taken)
    how = lambda k, s: {"time": None, "transform_matrix": (opengl_to_opencv(s.c2w) if wrong else s.c2w).tolist()}  # noqa: E731
    write_transforms(tmp_path, taken, frame=how)
    read, cut = [], placing._alpha
    monkeypatch.setattr(placing, "_alpha", lambda seq, i: read.append(i) or cut(seq, i))
    found = inspect(tmp_path, ReadOptions())
    assert sorted(read) == list(range(16)) and found.placed != wrong and (found.advice is not None) == wrong


def test_what_nothing_fits_is_refused(tmp_path, taken):
    """Cameras that stand far from one another, each before an object of its own."""
    write_pictures(tmp_path, taken)
    far = []
    for k, s in enumerate(taken):
        c2w = s.c2w.copy()
        c2w[:3, 3] += 50 * k * np.array([1, k % 3, -k % 5])
        far.append(replace(s, c2w=c2w))
    write_transforms(tmp_path, far, frame=lambda k, s: {"time": None})
    with pytest.raises(InputError, match="do not look at one object"):
        inspect(tmp_path, ReadOptions())


def views(places, frames=None, **how):
    out = []
    for k, place in enumerate(places):
        c2w = np.eye(4)
        c2w[:3, 3] = place
        out.append(View((frames or range(len(places)))[k], str(k), "", c2w, 9, 9, 4, 4, f"{k}.png"))
    return Sequence(8, 8, 24, 0, 9, views=out, **how)


def test_coverage_repetition_and_how_it_lies():
    six = [s * np.eye(3)[k] * 3 for k in range(3) for s in (-1, 1)]
    assert coverage(views(six)) == pytest.approx(6 * (1 - np.cos(np.radians(30))) / 2, abs=0.02)
    assert coverage(views(six[:1])) == pytest.approx((1 - np.cos(np.radians(30))) / 2, abs=0.01)
    assert (
        repeated(views(six)) == [] and "1 pictures have the camera" in repeated(views(six[:2] + six[1:2], [0, 1, 1]))[0]
    )
    double = views(six)
    double.views[3].image = "0.png"
    assert repeated(double) == ["1 pictures are listed twice"]
    assert "6 pictures by 6 cameras of 6 moments, 24 a second, 8x8 pixels" in counts(views(six))
    assert lying(views(six)) == ["up is y for its cameras, not z as in Blender: the asset will lie as they do"]
    for v in double.views:
        v.c2w[:3, :3] = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    assert lying(double) == []


def test_light_and_blur(tmp_path):
    rig = [[replace(s, time=t, camera=str(k)) for k, s in enumerate(shots(4))] for t in np.linspace(0, 1, 8)]
    write_panoptic(tmp_path, rig)
    rng = np.random.default_rng(0)
    for c in range(4):
        for n in range(8):
            save(tmp_path / f"ims/{c}/{6 * n:06d}.jpg", rng.integers(60, 140, (20, 24, 3), np.uint8), quality=95)
    found = inspect(tmp_path, ReadOptions())
    assert light(found.seq) == []
    save(tmp_path / "ims/2/000018.jpg", rng.integers(120, 240, (20, 24, 3), np.uint8), quality=95)
    save(tmp_path / "ims/1/000012.jpg", np.full((20, 24, 3), 100, np.uint8), quality=95)
    assert light(found.seq) == [
        "1 of 32 pictures are much brighter or darker than others of their camera: ims/2/000018.jpg",
        "1 of 32 pictures are blurred: ims/1/000012.jpg",
    ]


def test_times_at_which_nobody_looked(tmp_path, taken):
    moving = [replace(s, time=k / 30 if k < 10 else (k + 15) / 30) for k, s in enumerate(taken)]
    write_pictures(tmp_path, moving)
    write_transforms(tmp_path, moving, frame=lambda k, s: {"frame": k if k < 10 else k + 15})
    assert "no camera looked between the frames 9 and 25, elsewhere every 1" in inspect(tmp_path, ReadOptions()).lines


def test_from_the_command_line(tmp_path, taken, capsys, monkeypatch):
    pytest.importorskip("matplotlib")
    monkeypatch.chdir(tmp_path)
    write_pictures(tmp_path / "scene", taken)
    write_transforms(tmp_path / "scene", taken, frame=lambda k, s: {"time": None})
    assert main(["inspect", "scene"]) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith("nerfstudio: 16 pictures") and said[-1] == "inspect-scene.png"
    assert Image.open("inspect-scene.png").size[0] > 1000
    assert main(["inspect", "nowhere"]) == 2 and "no such file" in capsys.readouterr().err
