# SPDX-License-Identifier: GPL-3.0-or-later
"""D-NeRF's format: the same cameras, times and pictures come back, wherever and however large the scene is."""

import json
import math

import numpy as np
import pytest

from timesplat.datagen.readers.dnerf import read_dnerf
from timesplat.datagen.sequence import InputError, focal_from_fov


def test_cameras_times_and_pictures_come_back(write_dnerf):
    folder = write_dnerf()
    seq = read_dnerf(folder)
    assert (seq.width, seq.height, seq.fps, seq.frame_start, seq.frame_end) == (6, 4, 24, 0, 11)
    assert seq.root == folder and seq.provenance["asset"] == "scene" and "24 assumed" in seq.provenance["fps"]
    told = [(s, f) for s in ("train", "val", "test") for f in _read(folder, s)["frames"]]
    assert len(seq.views) == len(told) == 17
    for i, (v, (split, f)) in enumerate(zip(seq.views, told, strict=True)):
        assert v.rig == {"test": "target"}.get(split, split) and v.passes is None
        assert (v.cx, v.cy) == (3, 2) and v.fx == v.fy == pytest.approx(focal_from_fov(50, 4))
        np.testing.assert_allclose(seq.normalisation.to_world(v.c2w), f["transform_matrix"], atol=1e-9)
        assert seq.unit_time(v.frame) == pytest.approx(f["time"], abs=1e-9)
        assert v.image == f["file_path"][2:] + ".png" and seq.load_image(i).shape == (4, 6, 4)
    assert len({v.camera for v in seq.views}) == 17 and [v.camera for v in seq.views][11:13] == ["train-011", "val-000"]


def test_times_between_frames_are_fractions_and_whole_ones_are_whole(write_dnerf):
    seq = read_dnerf(write_dnerf())
    whole = [v.frame for v in seq.views if v.rig == "train"]
    assert whole == list(range(12)) and {type(f) for f in whole} == {int}
    between = [seq.views[i].frame for i in seq.select(rig="target")]
    assert between == pytest.approx([0, 11 / 3, 22 / 3]) and type(between[0]) is int
    np.testing.assert_allclose(seq.times(seq.select(rig="target")), [-1, -1 / 3, 1 / 3], atol=1e-6)


@pytest.mark.parametrize(("scale", "offset"), [(1.0, 0.0), (4.0, 10.0), (0.01, -3.0)])
def test_normalised_wherever_and_however_large(write_dnerf, scale, offset):
    seq = read_dnerf(write_dnerf(scale=scale, offset=offset))
    seen = 2.7 * math.tan(math.radians(25))  # half of what each camera sees of the plane through the middle, unscaled
    assert seq.normalisation.scale == pytest.approx(seen * scale)
    np.testing.assert_allclose(seq.normalisation.translation, [offset] * 3, atol=1e-6)
    for v in seq.views:
        assert np.linalg.norm(v.c2w[:3, 3]) == pytest.approx(2.7 / seen)


def test_without_times_it_is_still(write_dnerf):
    seq = read_dnerf(write_dnerf(moving=False))
    assert (seq.frame_start, seq.frame_end) == (0, 0) and not seq.times().any()
    assert {v.frame for v in seq.views} == {0}


def test_train_views_alone_and_what_is_stated(write_dnerf):
    folder = write_dnerf()
    (folder / "transforms_val.json").unlink()
    (folder / "transforms_test.json").unlink()
    _change(folder, lambda d: d.update(w=6, h=4, fl_x=7.0, fl_y=8.0, cx=2.5))
    _change(folder, lambda d: d["frames"][0].update(file_path="train/r_000.png", fl_x=9.0))
    seq = read_dnerf(folder)
    assert {v.rig for v in seq.views} == {"train"} and seq.views[0].image == "train/r_000.png"
    assert [(v.fx, v.fy, v.cx, v.cy) for v in seq.views[:2]] == [(9, 8, 2.5, 2), (7, 8, 2.5, 2)]


# ---------------------------------------------------------------- what can be wrong


def _read(folder, split="train"):
    return json.loads((folder / f"transforms_{split}.json").read_text())


def _change(folder, change, split="train"):
    d = _read(folder, split)
    d = change(d) or d
    (folder / f"transforms_{split}.json").write_text(d if isinstance(d, str) else json.dumps(d))


def _all_look_the_same_way(d):
    for k, f in enumerate(d["frames"]):
        f["transform_matrix"] = [[1, 0, 0, k], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]


def _look_outwards(d):
    for f in d["frames"]:
        turned = np.array(f["transform_matrix"]) * [-1, 1, -1, 1]
        f["transform_matrix"] = turned.tolist()


WRONG = {
    "not json": (lambda d: '{"frames": [', "transforms_train.json: it is damaged"),
    "not an object": (lambda d: [1], "it is damaged"),
    "frames missing": (lambda d: d.pop("frames") and None, "the entry 'frames' is missing"),
    "frames empty": (lambda d: d.update(frames=[]), "it has no frames"),
    "no angle": (lambda d: d.pop("camera_angle_x") and None, "the entry 'camera_angle_x' is missing"),
    "angle 0": (lambda d: d.update(camera_angle_x=0), "it is damaged"),
    "angle negative": (lambda d: d.update(camera_angle_x=-1), "the focal length of train/r_000.png is not positive"),
    "angle NaN": (lambda d: d.update(camera_angle_x=math.nan), "the focal length"),
    "picture missing": (lambda d: d["frames"][5].update(file_path="./train/no"), "no.png: the file is missing"),
    "first picture missing": (lambda d: d["frames"][0].update(file_path="./no"), "no.png: the file is missing"),
    "picture outside": (lambda d: d["frames"][1].update(file_path="../../etc/hosts"), "points outside"),
    "matrix short": (lambda d: d["frames"][2]["transform_matrix"].pop() and None, "not a finite 4x4 matrix"),
    "matrix NaN": (lambda d: d["frames"][2]["transform_matrix"][0].__setitem__(0, math.nan), "not a finite 4x4"),
    "matrix singular": (
        lambda d: d["frames"][2].update(transform_matrix=[[0.0] * 4] * 4),
        "the camera of train/r_002.png is singular",
    ),
    "matrix missing": (lambda d: d["frames"][2].pop("transform_matrix") and None, "'transform_matrix' is missing"),
    "a time missing": (lambda d: d["frames"][2].pop("time") and None, "the entry 'time' is missing"),
    "time beyond": (lambda d: d["frames"][2].update(time=1.5), "the time of ./train/r_002 is not within 0..1"),
    "time NaN": (lambda d: d["frames"][2].update(time=math.nan), "is not within 0..1"),
    "parallel": (_all_look_the_same_way, "its cameras all look the same way"),
    "outwards": (_look_outwards, "its cameras look away from one another"),
}


@pytest.mark.parametrize("case", WRONG)
def test_damage_is_named(write_dnerf, case):
    change, says = WRONG[case]
    folder = write_dnerf()
    _change(folder, change)
    with pytest.raises(InputError) as e:
        read_dnerf(folder)
    text = str(e.value)
    assert says in text and str(folder) in text and text.endswith(".") and "\n" not in text and "render" not in text


def test_damage_of_other_splits_names_their_file(write_dnerf):
    folder = write_dnerf()
    _change(folder, lambda d: d["frames"][1].update(transform_matrix=[[0.0] * 4] * 4), "val")
    with pytest.raises(InputError, match=r"transforms_val\.json: the camera of val/r_001\.png is singular"):
        read_dnerf(folder)
    _change(folder, lambda d: "[", "val")
    with pytest.raises(InputError, match=r"transforms_val\.json: it is damaged"):
        read_dnerf(folder)


def test_pictures_of_other_sizes_are_named(write_dnerf):
    folder = write_dnerf()
    (folder / "val" / "r_000.png").write_bytes(b"not a picture")
    seq = read_dnerf(folder)
    with pytest.raises(InputError, match=r"val/r_000\.png: the image cannot be read .* get the data set again"):
        seq.load_image(12)
    _change(folder, lambda d: d.update(w=12, h=8))
    with pytest.raises(InputError, match=r"r_000\.png: the image is 6x4 but those of the Sequence are 12x8"):
        read_dnerf(folder).load_image(0)


def test_another_folder_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"transforms_train\.json: no such file"):
        read_dnerf(tmp_path)
