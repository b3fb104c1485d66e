# SPDX-License-Identifier: GPL-3.0-or-later
"""`timesplat video`: from arguments to a file."""

import json
import math

import numpy as np
import pytest
from PIL import Image

from timesplat.cli import main
from timesplat.datagen.readers import open_sequence
from timesplat.datagen.rigs import look_at
from timesplat.datagen.sequence import InputError
from timesplat.model.film_command import background, cameras, read_cameras, size
from timesplat.model.io.asset import Clip
from timesplat.model.io.ply import write_ply

from ..assets import make_asset

CLIP = Clip(24.0, 3, 5, 2.0, (1.0, 2.0, 3.0))


@pytest.fixture
def ply(tmp_path):
    write_ply(tmp_path / "a.ply", make_asset(30, clip=CLIP))
    return tmp_path / "a.ply"


def video(*words) -> int:
    return main(["video", *map(str, words)])


def test_a_turntable(ply, tmp_path, capsys):
    assert video(ply, tmp_path / "t.webp", "--size", "40x24", "--plays", 2, "--fps", 12) == 0
    assert "t.webp: 4 pictures of 40 x 24, 0.3 s" in capsys.readouterr().out
    with Image.open(tmp_path / "t.webp") as film:
        assert film.n_frames == 4 and film.size == (40, 24)
    assert video(ply, tmp_path / "p", "--size", "32", "--plays", 1) == 0
    pictures = [np.asarray(Image.open(p)) for p in sorted((tmp_path / "p").iterdir())]
    assert len(pictures) == 3 and all(p.shape == (32, 32, 4) and p[0, 0, 3] == 0 for p in pictures)


def test_cameras_of_a_list(ply, tmp_path, capsys):
    listed = [
        {"frame": f, "transform_matrix": look_at((1, -8 - f, 3), (1, 2, 3)).tolist(), "camera_angle_x": 0.7}
        for f in (3, 4, 5)
    ]
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps({"frames": listed}))
    shots = read_cameras(path)
    assert [s.frame for s in shots] == [3, 4, 5] and shots[0].fov == pytest.approx(math.degrees(0.7))
    assert video(ply, tmp_path / "c.webp", "--camera", path, "--size", "48") == 0
    assert "3 pictures of 48 x 48, 0.1 s" in capsys.readouterr().out
    assert video(ply, tmp_path / "d.webp", "--camera", path, "--size", "48", "--fps", 48) == 0
    assert "6 pictures" in capsys.readouterr().out, "at twice the rate each is there twice"


def test_cameras_of_a_sequence(sphere_folder, ply, tmp_path, capsys):
    seq = open_sequence(sphere_folder)
    shots, (width, height) = cameras(str(sphere_folder))
    assert len(shots) == len(seq.views) and (width, height) == (seq.width, seq.height)
    assert [s.frame for s in shots] == sorted(v.frame for v in seq.views)
    name = seq.views[0].camera
    one, _ = cameras(f"{sphere_folder}:{name}")
    assert len(one) == sum(v.camera == name for v in seq.views) and {s.camera for s in one} == {name}
    np.testing.assert_allclose(one[0].c2w, seq.normalisation.to_world(seq.views[0].c2w))
    with pytest.raises(InputError, match="no camera moon; it has"):
        cameras(f"{sphere_folder}:moon")
    assert video(ply, tmp_path / "s.webp", "--camera", sphere_folder) == 0
    assert f"{len(shots)} pictures of {seq.width} x {seq.height}" in capsys.readouterr().out


def test_sizes_and_colours():
    assert size(None, 640, 480) == (640, 480) and size("320", 640, 480) == (320, 240)
    assert size("100", 30, 60) == (50, 100) and size("1280x720", 1, 1) == (1280, 720)
    from pathlib import Path

    assert background(None, Path("a.mp4")) == (1, 1, 1) and background(None, Path("a")) is None
    assert background("none", Path("a.webp")) is None and background("#ff0080", Path("a")) == (1, 0, 128 / 255)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("a.ply a.gif", "a.gif: films are .mp4 or .webp"),
        ("a.ply a.mp4 --size big", "big: give a size as 512 or 1280x720"),
        ("a.ply a.mp4 --size 4", "4 x 4 pixels: give sizes from 16"),
        ("a.ply a.mp4 --background red", "red: give a background as six"),
        ("a.ply a.mp4 --background none", "an .mp4 cannot be transparent"),
        ("a.ply a.mp4 --fps 0", "0 frames a second"),
        ("a.ply a.mp4 --plays 0", "--plays is for the turntable, and 1 or more"),
        ("a.ply a.webp --camera none.json", "none.json: it cannot be read"),
        ("a.ply a.webp --camera bad.json", "bad.json: it is no list of cameras"),
        ("a.ply a.webp --camera flat.json", "camera 0 is scaled, sheared or mirrored"),
        ("b.ply a.webp", "b.ply: no such file"),
    ],
)
def test_what_cannot_be_is_a_sentence(ply, tmp_path, monkeypatch, capsys, words, says):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bad.json").write_text("[1")
    entry = {"frame": 1, "transform_matrix": np.diag([1, 1, 0, 1]).tolist(), "camera_angle_x": 1}
    (tmp_path / "flat.json").write_text(json.dumps({"frames": [entry]}))
    assert video(*words.split()) == 2
    err = capsys.readouterr().err
    assert says in err and len(err.strip().splitlines()) == 1
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.ply", "bad.json", "flat.json"]
