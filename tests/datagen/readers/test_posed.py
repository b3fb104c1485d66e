# SPDX-License-Identifier: GPL-3.0-or-later
"""One scene in every layout and convention: the same cameras, moments and pictures come out. What was misread before
is among it: lenses, axes, scales, sizes, seconds, fractions of frames."""

import json
from dataclasses import replace

import numpy as np
import pytest

from timesplat.datagen.readers import open_sequence
from timesplat.datagen.readers.lenses import Lens
from timesplat.datagen.readers.options import ReadOptions
from timesplat.datagen.sequence import InputError, opengl_to_opencv

from .worlds import (
    BALLS,
    MOTION,
    PLAIN,
    RADIUS,
    on_white,
    photograph,
    save,
    shots,
    write_colmap,
    write_panoptic,
    write_pictures,
    write_transforms,
)


@pytest.fixture(scope="module")
def taken():
    return shots()


@pytest.fixture(scope="module")
def truth(taken):
    """The pictures that pinhole cameras take."""
    return [photograph(s) for s in taken]


def over_white(rgba):
    return on_white(rgba).astype(int)


def same(seq, taken, truth, atol=0, lens=PLAIN, moving=True):
    """Cameras and moments to rounding, pictures over white to `atol` levels in the mean of each."""
    assert len(seq.views) == len(taken) and (seq.width, seq.height) == (lens.width, lens.height)
    for k, (v, s) in enumerate(zip(seq.views, taken, strict=True)):
        np.testing.assert_allclose(seq.normalisation.to_world(v.c2w), s.c2w, atol=1e-9)
        assert (v.fx, v.fy, v.cx, v.cy) == pytest.approx((lens.fx, lens.fy, lens.cx, lens.cy), abs=1e-9)
        assert seq.unit_time(v.frame) == pytest.approx(s.time if moving else 0, abs=1e-6)
        got = seq.load_image(k)
        assert got.dtype == np.uint8
        if not atol:
            assert (got == truth[k]).all()
        else:
            assert np.abs(over_white(got) - over_white(truth[k])).mean() <= atol
            wrong = (got[..., 3] > 127) != (truth[k][..., 3] > 127)
            assert wrong.mean() < 0.05
    inside = np.array(seq.aabb)
    assert (np.abs(inside) <= 1).all() and np.abs(inside).max() > 0.5
    return seq


def known(seq, scale=1.0, offset=0.0):
    """The volume that was found holds the balls at all times, and is not much larger."""
    rng = np.random.default_rng(0)
    d = rng.normal(size=(200, 3))
    ball = RADIUS / 2 * d / np.linalg.norm(d, axis=1, keepdims=True)
    points = np.concatenate([ball + m + t * v for m, v in zip(BALLS, MOTION, strict=True) for t in (0, 0.5, 1)])
    unit = (scale * points + offset - seq.normalisation.translation) / seq.normalisation.scale
    # With a dozen views in all, each of another moment, what moves is not known better.
    assert np.abs(unit).max() < 1.1 and 0.75 < np.linalg.norm(unit, axis=1).max() < 1.3


CONVENTIONS = {
    "opencv": lambda m: opengl_to_opencv(m),
    "left-handed": lambda m: np.diag([1, 1, -1, 1]) @ m @ np.diag([1, 1, -1, 1]),
    "w2c-opengl": np.linalg.inv,
    "w2c-opencv": lambda m: np.linalg.inv(opengl_to_opencv(m)),
}


def test_nerfstudio_as_it_is(tmp_path, taken, truth):
    write_pictures(tmp_path, taken)
    seq = same(open_sequence(write_transforms(tmp_path, taken)), taken, truth)
    known(seq)
    assert (seq.frame_start, seq.frame_end, seq.fps) == (0, 11, 24) and seq.provenance["format"] == "nerfstudio"
    assert any("visual hull" in x for x in seq.provenance["read"])
    assert {v.rig for v in seq.views} == {"train"} and len({v.camera for v in seq.views}) == 12


@pytest.mark.parametrize("axes", CONVENTIONS)
def test_axes_that_are_told(tmp_path, taken, truth, axes):
    write_pictures(tmp_path, taken)
    write_transforms(tmp_path, taken, frame=lambda k, s: {"transform_matrix": CONVENTIONS[axes](s.c2w).tolist()})
    known(same(open_sequence(tmp_path, ReadOptions(axes=axes)), taken, truth))


def test_3x4_matrices_and_an_angle_alone(tmp_path, taken, truth):
    write_pictures(tmp_path, taken)

    def change(d):
        for key in ("fl_x", "fl_y", "w", "h", "cx", "cy"):
            del d[key]
        d["camera_angle_x"] = 2 * np.arctan(PLAIN.width / 2 / PLAIN.fx)
        d["camera_angle_y"] = 2 * np.arctan(PLAIN.height / 2 / PLAIN.fy)
        for f in d["frames"]:
            f |= {"transform_matrix": f["transform_matrix"][:3], "cx": PLAIN.cx, "cy": PLAIN.cy}

    same(open_sequence(write_transforms(tmp_path, taken, change)), taken, truth)


@pytest.mark.parametrize(("scale", "offset"), [(4.0, 0.0), (1.0, 10.0), (0.02, -7.0)])
def test_scale_and_place(tmp_path, truth, scale, offset):
    moved = shots(scale=scale, offset=offset)
    write_pictures(tmp_path, moved, scale, offset)
    seq = same(open_sequence(write_transforms(tmp_path, moved)), moved, truth)
    known(seq, scale, offset)
    assert np.median([np.linalg.norm(v.c2w[:3, 3]) for v in seq.views]) == pytest.approx(4.1, abs=0.2)


LENSES = {
    "opencv": ({"k1": 0.3, "k2": 0.1}, {"radial": (0.3, 0.1, 0.0, 0.0)}),
    "tangential": ({"k1": -0.1, "p1": 0.01, "p2": -0.02}, {"radial": (-0.1, 0, 0, 0), "tangential": (0.01, -0.02)}),
    "fisheye": ({"camera_model": "OPENCV_FISHEYE", "k1": 0.1}, {"radial": (0.1, 0, 0, 0), "fisheye": True}),
    "is_fisheye": ({"is_fisheye": True, "aabb_scale": 4}, {"fisheye": True}),
}


@pytest.mark.parametrize("kind", LENSES)
def test_lenses_are_straightened(tmp_path, kind):
    """Pictures taken through a lens come out as those of the pinhole camera do, and differ much before."""
    top, more = LENSES[kind]
    plain = PLAIN.resized(96, 80)
    straight, bent = shots(6, lens=plain), shots(6, lens=replace(plain, **more))
    truth, before = ([photograph(s, across=2) for s in x] for x in (straight, bent))
    for k, picture in enumerate(before):
        save(tmp_path / f"images/{k:04d}.png", picture)
    seq = open_sequence(write_transforms(tmp_path, bent, **top))
    same(seq, straight, truth, atol=0.5, lens=plain)
    after = [seq.load_image(k) for k in range(6)]
    wrong = [
        sum((np.abs(x[..., 3].astype(int) - t[..., 3]) > 140).sum() for x, t in zip(pictures, truth, strict=True))
        for pictures in (before, after)
    ]
    assert wrong[1] < 0.05 * wrong[0] and wrong[0] > 50, wrong
    assert any("is undone" in x for x in seq.provenance["read"])


def test_mixed_sizes_and_lenses_of_each_frame(tmp_path, taken, truth):
    half = Lens(PLAIN.width // 2, PLAIN.height // 2, *(x / 2 for x in (PLAIN.fx, PLAIN.fy, PLAIN.cx, PLAIN.cy)))
    mixed = [replace(s, lens=half) if k % 3 == 2 else s for k, s in enumerate(taken)]
    write_pictures(tmp_path, mixed)

    def own(k, s):
        keys = {"w": "width", "h": "height", "fl_x": "fx", "fl_y": "fy", "cx": "cx", "cy": "cy"}
        return {key: getattr(s.lens, name) for key, name in keys.items()}

    seq = open_sequence(write_transforms(tmp_path, mixed, frame=own))
    known(same(seq, taken, truth, atol=8))
    assert all((seq.load_image(k) == truth[k]).all() for k in (0, 1, 3, 4))
    assert any("4 pictures of other sizes" in x for x in seq.provenance["read"])


def test_jpeg_on_white(tmp_path, taken, truth):
    write_pictures(tmp_path, taken, name="images/{k:04d}.jpg", white=True, quality=95, subsampling=0)
    write_transforms(tmp_path, taken, frame=lambda k, s: {"file_path": f"./images/{k:04d}.jpg"})
    seq = same(open_sequence(tmp_path), taken, truth, atol=4)
    known(seq)
    assert any("measured there" in x for x in seq.provenance["read"])
    told = open_sequence(tmp_path, ReadOptions(background="white"))
    assert any("--background says" in x for x in told.provenance["read"])


def test_masks(tmp_path, taken, truth):
    for k, picture in enumerate(truth):
        save(tmp_path / f"images/{k:04d}.png", picture[..., :3])
        save(tmp_path / f"masks/{k:04d}.png", picture[..., 3])
    write_transforms(tmp_path, taken, frame=lambda k, s: {"mask_path": f"masks/{k:04d}.png"})
    known(same(open_sequence(tmp_path), taken, truth))


@pytest.mark.parametrize("unit", ["seconds", "frames", "both", "frame"])
def test_times_in_every_unit(tmp_path, taken, truth, unit):
    write_pictures(tmp_path, taken)
    frames = {
        "seconds": lambda k, s: {"time": 100 + k / 30},
        "frames": lambda k, s: {"time": k},
        "both": lambda k, s: {"time": 100 + k / 30, "frame": k},
        "frame": lambda k, s: {"time": None, "frame": k},
    }
    seq = same(open_sequence(write_transforms(tmp_path, taken, frame=frames[unit])), taken, truth)
    assert seq.fps == (30 if unit in ("seconds", "both") else 24)


def test_half_frames_are_kept(tmp_path, taken):
    write_pictures(tmp_path, taken)
    write_transforms(tmp_path, taken, frame=lambda k, s: {"frame": k + 0.5}, frame_start=0, frame_end=11)
    seq = open_sequence(tmp_path)
    assert [v.frame for v in seq.views] == [k + 0.5 for k in range(12)] and (seq.frame_start, seq.frame_end) == (0, 12)


@pytest.mark.parametrize("binary", [False, True])
def test_colmap(tmp_path, taken, truth, binary):
    write_pictures(tmp_path, taken)
    write_colmap(tmp_path, taken, [f"{k:04d}.png" for k in range(12)], binary)
    known(same(open_sequence(tmp_path), taken, truth, moving=False))
    seq = open_sequence(tmp_path, ReadOptions(times=r"(\d+)\.png"))
    known(same(seq, taken, truth))
    assert seq.provenance["format"] == "COLMAP" and seq.frame_end == 11


def test_panoptic(tmp_path):
    rig = [[replace(s, time=t) for s in shots(6)] for t in (0.0, 0.5, 1.0)]
    rig = [[replace(s, camera=str(k)) for k, s in enumerate(group)] for group in rig]
    seq = open_sequence(write_panoptic(tmp_path, rig, held_out={"1", "4"}))
    known(seq)
    assert (seq.frame_start, seq.frame_end, len(seq.views)) == (0, 2, 18)
    assert {v.camera for v in seq.views if v.rig == "target"} == {"1", "4"} and len(seq.select(rig="train")) == 12
    for i, v in enumerate(seq.views):
        s = rig[v.frame][int(v.camera)]
        np.testing.assert_allclose(seq.normalisation.to_world(v.c2w), s.c2w, atol=1e-9)
        rgba, expected = seq.load_image(i), photograph(s)
        if v.rig == "train":
            assert (rgba[..., 3] == expected[..., 3]).all()
            assert np.abs(over_white(rgba) - over_white(expected)).mean() < 8
        else:
            assert (rgba[..., 3] == 255).all()  # it has no mask


def test_splits_are_rigs(tmp_path, taken):
    write_pictures(tmp_path, taken)
    names = [f"images/{k:04d}.png" for k in range(12)]
    top = {"train_filenames": names[:8], "val_filenames": names[8:10], "test_filenames": names[10:]}
    seq = open_sequence(write_transforms(tmp_path, taken, **top))
    assert [v.rig for v in seq.views] == ["train"] * 8 + ["val"] * 2 + ["target"] * 2


def test_the_volume_can_be_told(tmp_path, taken):
    write_pictures(tmp_path, taken)
    write_transforms(tmp_path, taken)
    seq = open_sequence(tmp_path, ReadOptions(aabb=(-1, -1, -1, 3, 1, 1)))
    assert seq.normalisation.translation == (1, 0, 0) and seq.normalisation.scale == pytest.approx(1.02 * 6**0.5 / 1.1)
    assert open_sequence(tmp_path, ReadOptions(scale=7)).normalisation.scale == 7


def test_the_whole_scene_if_it_is_asked_for(tmp_path, taken):
    write_pictures(tmp_path, taken)
    write_transforms(tmp_path, taken)
    alone, whole = open_sequence(tmp_path), open_sequence(tmp_path, ReadOptions(scene=True))
    assert alone.load_image(3)[..., 3].min() == 0 and whole.load_image(3)[..., 3].min() == 255
    assert any("as --scene says" in x for x in whole.provenance["read"])
    with pytest.raises(InputError, match="leave out --background"):
        ReadOptions(scene=True, background="white")


def test_without_anything_that_tells_the_object(tmp_path, taken):
    rng = np.random.default_rng(0)
    for k in range(12):
        save(tmp_path / f"images/{k:04d}.png", rng.integers(0, 256, (20, 24, 3), np.uint8))
    seq = open_sequence(write_transforms(tmp_path, taken))
    assert any("the whole scene" in x for x in seq.provenance["read"]) and seq.load_image(3)[..., 3].min() == 255
    assert seq.normalisation.translation == pytest.approx((0, 0, 0), abs=1e-6)
    rows = [[0.1 * a, 0.1 * b, 0.1 * c] for a in range(5) for b in range(5) for c in range(5)]
    (tmp_path / "transforms.json").unlink()
    write_colmap(tmp_path, taken, [f"{k:04d}.png" for k in range(12)], points=rows)
    found = open_sequence(tmp_path)
    assert found.normalisation.translation == pytest.approx((0.2, 0.2, 0.2), abs=0.01)
    assert any("what half of the cameras see of 125 points" in x for x in found.provenance["read"])


def test_pictures_smaller_than_stated(tmp_path, taken, truth):
    write_pictures(tmp_path, taken)
    double = [replace(s, lens=PLAIN.resized(48, 40)) for s in taken]
    seq = same(open_sequence(write_transforms(tmp_path, double)), taken, truth)
    assert any("24x20, not 48x40 as stated" in x for x in seq.provenance["read"])


def _all(turn):
    return lambda d: [f.update(transform_matrix=turn(np.array(f["transform_matrix"])).tolist()) for f in d["frames"]]


def _first(change):
    return lambda d: d["frames"][1].update(change(d["frames"][1]))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (_first(lambda f: {"file_path": "images/none.png"}), r"images/none\.png: the image is missing"),
        (_first(lambda f: {"file_path": "../x.png"}), r"\.\./x\.png points outside of the folder"),
        (_first(lambda f: {"transform_matrix": [[0.0] * 4] * 4}), r"0001\.png is singular or not a rotation"),
        (_first(lambda f: {"transform_matrix": [[float("nan")] * 4] * 4}), r"0001\.png is not a finite matrix"),
        (_first(lambda f: {"transform_matrix": [[1.0] * 4] * 2}), "2x4, not 4x4 or 3x4"),
        (_first(lambda f: {"camera_model": "EQUIRECTANGULAR"}), "EQUIRECTANGULAR is no lens model that is read"),
        (_first(lambda f: {"w": 20, "h": 24}), r"0001\.png: the image is 24x20, stated are 20x24"),
        (_first(lambda f: {"fl_x": 0}), r"the focal length of images/0001\.png is not positive"),
        (_first(lambda f: {"mask_path": "masks/none.png"}), r"masks/none\.png: the mask is missing"),
        (_first(lambda f: {"mask_path": "small.png"}), r"small\.png: the mask is 12x10, its picture 24x20"),
        (_first(lambda f: {"time": None}), r"images/0001\.png has no time"),
        (lambda d: [f.update(time=0.25) for f in d["frames"]], r"all of its times are the same .* --times none"),
        (lambda d: d.update(frames=[]), "it has no frames"),
        (lambda d: d["frames"][3].pop("transform_matrix"), "the entry 'transform_matrix' is missing"),
        (lambda d: d.pop("fl_x"), "the entry 'camera_angle_x' is missing"),
        (_all(lambda m: np.diag([1, 1, -1, 1]) @ m), r"is left-handed; pass --axes left-handed"),
        (_all(opengl_to_opencv), r"its cameras do not look at one object: .* `timesplat inspect`"),
    ],
)  # fmt: skip
def test_refused_in_one_sentence(tmp_path, taken, change, says):
    write_pictures(tmp_path, taken)
    save(tmp_path / "small.png", np.full((10, 12), 255, np.uint8))
    write_transforms(tmp_path, taken, change)
    with pytest.raises(InputError, match=says) as e:
        open_sequence(tmp_path)
    assert "\n" not in str(e.value) and str(tmp_path) in str(e.value)


def test_nothing_in_any_mask_is_refused(tmp_path, taken):
    for k in range(12):
        save(tmp_path / f"images/{k:04d}.png", np.zeros((20, 24, 4), np.uint8))
    with pytest.raises(InputError, match=r"transforms\.json: no picture shows anything of an object"):
        open_sequence(write_transforms(tmp_path, taken))


def test_instant_ngp_leaves_out_what_is_not_there(tmp_path, taken, truth):
    write_pictures(tmp_path, taken)
    (tmp_path / "images/0011.png").unlink()
    seq = open_sequence(write_transforms(tmp_path, taken, aabb_scale=4))
    assert len(seq.views) == 11 and seq.provenance["format"] == "instant-ngp"
    assert any("1 pictures that it lists are not there" in x for x in seq.provenance["read"])


def test_suffixes_and_what_is_applied(tmp_path, taken, truth):
    write_pictures(tmp_path, taken)
    applied = [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]
    write_transforms(tmp_path, taken, frame=lambda k, s: {"file_path": f"./images/{k:04d}"}, applied_transform=applied)
    seq = same(open_sequence(tmp_path), taken, truth)
    assert seq.provenance["applied_transform"] == applied
    json.dumps(seq.provenance)  # it goes into files
