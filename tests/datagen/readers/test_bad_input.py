# SPDX-License-Identifier: GPL-3.0-or-later
"""What cannot be right in others' data: one sentence that names the file and says what to do, exit code 2, nothing
written, whichever command reads it."""

import json

import numpy as np
import pytest

from timesplat.cli import main

from .worlds import on_white, photograph, save, shots, write_colmap, write_panoptic, write_transforms


@pytest.fixture
def scene(tmp_path):
    taken = shots(12)
    for k, s in enumerate(taken):
        rgba = photograph(s)
        save(tmp_path / f"scene/images/{k:04d}.png", on_white(rgba))
        save(tmp_path / f"scene/masks/{k:04d}.png", rgba[..., 3])
    return write_transforms(tmp_path / "scene", taken, frame=lambda k, s: {"mask_path": f"masks/{k:04d}.png"})


def edit(scene, change):
    path = scene / "transforms.json"
    d = json.loads(path.read_text())
    for k, f in enumerate(d["frames"]):
        change(k, f)
    path.write_text(json.dumps(d))


def missing_picture(scene):
    (scene / "images/0003.png").unlink()


def damaged_picture(scene):
    (scene / "images/0003.png").write_bytes((scene / "images/0003.png").read_bytes()[:40])


def singular_camera(scene):
    edit(scene, lambda k, f: f.update(transform_matrix=np.zeros((4, 4)).tolist()) if k == 3 else None)


def no_overlap(scene):
    def change(k, f):
        f["transform_matrix"][0][3] += 90 * k
        f["transform_matrix"][1][3] -= 70 * (k % 5)

    edit(scene, change)


def equal_times(scene):
    edit(scene, lambda k, f: f.update(time=0.5))


def mask_of_another_size(scene):
    save(scene / "masks/0003.png", np.full((10, 12), 255, np.uint8))


def unknown_lens(scene):
    edit(scene, lambda k, f: f.update(camera_model="FOV"))


def no_foreground(scene):
    for k in range(12):
        save(scene / f"masks/{k:04d}.png", np.zeros((20, 24), np.uint8))


SAYS = {
    missing_picture: "images/0003.png: the image is missing; ",
    damaged_picture: "images/0003.png: the image cannot be read (",
    singular_camera: "transforms.json: the camera of images/0003.png is singular or not a rotation; correct it.",
    no_overlap: "transforms.json: its cameras do not look at one object: ",
    equal_times: "transforms.json: all of its times are the same although it has 12 pictures; correct them, or pass",
    mask_of_another_size: "masks/0003.png: the mask is 12x10, its picture 24x20; give masks of the pictures' size.",
    unknown_lens: "transforms.json: FOV is no lens model that is read; undistort the pictures first, or give one of",
    no_foreground: "transforms.json: no picture shows anything of an object; check masks and background.",
}


@pytest.mark.parametrize("command", ["import", "reconstruct", "inspect"])
@pytest.mark.parametrize("spoil", SAYS, ids=lambda f: f.__name__)
def test_one_sentence_and_exit_code_2(scene, tmp_path, capsys, spoil, command):
    if command == "reconstruct":
        pytest.importorskip("torch")
    spoil(scene)
    out = tmp_path / {"import": "out", "reconstruct": "out.ply", "inspect": "out.png"}[command]
    assert main([command, str(scene), "--out", str(out)]) == 2
    said = capsys.readouterr().err.strip()
    assert said.startswith(f"timesplat: {scene}/{SAYS[spoil]}") and "\n" not in said and said.endswith(".")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["scene"]


def test_the_same_of_other_layouts(tmp_path, capsys):
    taken = shots(12)
    colmap = write_colmap(tmp_path / "c", taken, [f"{k:04d}.png" for k in range(12)], True, (7, "FOV"), [1.0] * 5)
    assert main(["import", str(colmap), "--out", str(tmp_path / "out")]) == 2
    assert "cameras.bin: FOV is no lens model that is read; run COLMAP's image_undistorter" in capsys.readouterr().err
    panoptic = write_panoptic(tmp_path / "p", [taken[:6], taken[6:]])
    next((panoptic / "ims").rglob("*.jpg")).unlink()
    assert main(["import", str(panoptic), "--out", str(tmp_path / "out")]) == 2
    assert ".jpg: the image is missing; " in capsys.readouterr().err and not (tmp_path / "out").exists()
