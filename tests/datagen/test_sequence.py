# SPDX-License-Identifier: GPL-3.0-or-later
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from timesplat.datagen import image_files, rigs
from timesplat.datagen import sequence as sq
from timesplat.datagen.passes import Passes, write_passes
from timesplat.datagen.sequence import InputError, Normalisation, Sequence, View


def make(folder, frames=3, size=(6, 4), passes=True, provenance=None):
    rng = np.random.default_rng(0)
    w, h = size
    seq = Sequence(w, h, 24.0, 0, frames - 1, Normalisation(2.5, (1.0, -2.0, 0.5)), provenance=provenance or {})
    seq.views = [View(s.frame, s.camera, s.rig, s.c2w, 7.0, 7.0, w / 2, h / 2) for s in rigs.orbit(range(frames))]

    def fill(tmp):
        for i, v in enumerate(seq.views):
            v.image = f"{i}.png"
            image_files.write_png(tmp / v.image, rng.integers(0, 256, (h, w, 4), np.uint8))
            if passes:
                v.passes = f"{i}.exr"
                depth = rng.random((h, w), np.float32) + 2
                depth[0] = np.inf
                write_passes(tmp / v.passes, Passes(depth, *rng.normal(size=(2, h, w, 2))))

    return sq.write_sequence(seq, folder, fill)


def sentence(error, *parts):
    text = str(error.value)
    assert text.endswith(".") and "\n" not in text and ";" in text
    for p in parts:
        assert p in text


def test_round_trip(tmp_path):
    seq = make(tmp_path / "a", provenance={"asset": "x", "seed": 3})
    again = sq.read_sequence(tmp_path / "a")
    assert (again.width, again.height, again.frame_end, again.provenance) == (6, 4, 2, {"asset": "x", "seed": 3})
    assert again.normalisation == Normalisation(2.5, (1.0, -2.0, 0.5))
    for i, (v, s) in enumerate(zip(again.views, rigs.orbit(range(3)), strict=True)):
        assert np.array_equal(v.c2w, s.c2w) and v.rig == "orbit"
        assert seq.load_image(i).shape == (4, 6, 4)
        p = seq.load_passes(i)
        assert np.isinf(p.depth[0]).all() and np.isfinite(p.depth[1:]).all()
    d = json.loads((tmp_path / "a" / "transforms.json").read_text())
    assert [f["time"] for f in d["frames"]] == [0, 0.5, 1]  # D-NeRF's
    assert np.allclose(again.times(), [-1, 0, 1])
    assert make(tmp_path / "still", frames=1).times().tolist() == [0]


def test_cameras_for_the_model_look_along_z(tmp_path):
    c2w, K = make(tmp_path / "a").cameras([1])
    ahead = c2w[0, :3, 2]
    assert ahead @ (-c2w[0, :3, 3]) / np.linalg.norm(c2w[0, :3, 3]) == pytest.approx(1, abs=1e-5)
    assert c2w[0, 2, 1] < 0  # y of the image points down
    assert K.tolist() == [[7, 7, 3, 2]]


@given(
    hnp.arrays(np.float64, 3, elements=st.floats(-1e3, 1e3)),
    st.floats(1e-3, 1e3),
    st.integers(0, 359),
    st.integers(-89, 89),
)
def test_normalisation_there_and_back(translation, scale, azimuth, elevation):
    n, c2w = Normalisation(scale, tuple(translation)), rigs.spherical(azimuth, elevation)
    back = n.from_world(n.to_world(c2w))
    assert np.allclose(back, c2w, atol=1e-6) and np.array_equal(back[:3, :3], c2w[:3, :3])


def changed(folder, change):
    """The Sequence of three frames in a folder after a change of its JSON."""
    broken(folder, change)
    return sq.read_sequence(folder)


def test_fractions_of_a_frame_are_kept_and_whole_ones_are_whole(tmp_path):
    def between(d):
        for f, frame in zip(d["frames"], (0, 0.5, 2.0), strict=True):
            f["frame"] = frame

    seq = changed(tmp_path / "a", between)
    assert [v.frame for v in seq.views] == [0, 0.5, 2] and type(seq.views[2].frame) is int
    assert seq.times().tolist() == [-1, -0.5, 1] and seq.select(frame=0.5) == [1]


def test_a_sequence_written_again_is_the_same_file(tmp_path):
    seq = make(tmp_path / "a")

    def again(tmp):
        for v in seq.views:
            for name in (v.image, v.passes):
                (tmp / name).write_bytes((tmp_path / "a" / name).read_bytes())

    sq.write_sequence(seq, tmp_path / "b", again)
    assert (tmp_path / "a" / "transforms.json").read_bytes() == (tmp_path / "b" / "transforms.json").read_bytes()


@pytest.mark.parametrize(
    ("frames", "stated", "clip"),
    [
        ((0, 5, 11), {}, (0, 11)),
        ((3, 3, 3), {}, (3, 3)),
        ((0.5, 1.5, 2.5), {}, (0, 3)),
        ((4, 5, 6), {"frame_end": 8}, (4, 8)),
        ((4, 5, 6), {"frame_start": 1}, (1, 6)),
    ],
)
def test_without_a_range_it_is_that_of_the_frames(tmp_path, frames, stated, clip):
    def change(d):
        del d["frame_start"], d["frame_end"]
        d.update(stated)
        for f, frame in zip(d["frames"], frames, strict=True):
            f["frame"] = frame

    seq = changed(tmp_path / "a", change)
    assert (seq.frame_start, seq.frame_end) == clip and (len(set(frames)) == 1 or len(set(seq.times().tolist())) == 3)


def test_an_angle_is_enough(tmp_path):
    def change(d):
        d["camera_angle_x"] = 2 * np.arctan(6 / 2 / 7)
        for f in d["frames"]:
            del f["fl_x"], f["fl_y"]

    seq = changed(tmp_path / "a", change)
    assert all(v.fx == v.fy == pytest.approx(7) for v in seq.views)


# ---------------------------------------------------------------- what can be wrong


def broken(folder, change):
    make(folder)
    path = folder / "transforms.json"
    d = json.loads(path.read_text())
    d = change(d) or d
    path.write_text(json.dumps(d) if not isinstance(d, str) else d)


WRONG = {
    "not json": (lambda d: "{", "damaged"),
    "not an object": (lambda d: [1], "damaged"),
    "no frames": (lambda d: d.pop("frames") and None, "'frames' is missing"),
    "empty": (lambda d: d.update(frames=[]), "empty"),
    "no size": (lambda d: d.pop("w") and None, "'w' is missing"),
    "negative size": (lambda d: d.update(h=-4), "negative"),
    "fps 0": (lambda d: d.update(fps=0), "fps"),
    "range backwards": (lambda d: d.update(frame_end=-1), "range"),
    "scale 0": (lambda d: d["normalisation"].update(scale=0), "normalisation"),
    "scale NaN": (lambda d: d["normalisation"].update(scale=float("nan")), "normalisation"),
    "matrix short": (lambda d: d["frames"][1]["transform_matrix"].pop() and None, "4x4"),
    "matrix NaN": (lambda d: d["frames"][1]["transform_matrix"][0].__setitem__(0, float("nan")), "finite"),
    "matrix scaled": (
        lambda d: d["frames"][1].update(transform_matrix=(2 * np.eye(4)).tolist()),
        "not a rotation",
    ),
    "matrix mirrored": (
        lambda d: d["frames"][0].update(transform_matrix=np.diag([1.0, 1, -1, 1]).tolist()),
        "not a rotation",
    ),
    "frame missing": (lambda d: d["frames"][1].pop("frame") and None, "'frame' is missing"),
    "frame NaN": (lambda d: d["frames"][1].update(frame=float("nan")), "the frame nan is not finite"),
    "no focal": (lambda d: [f.pop("fl_x") for f in d["frames"]] and None, "'camera_angle_x' is missing"),
    "focal 0": (lambda d: d["frames"][2].update(fl_x=0), "focal"),
    "frame beyond": (lambda d: d["frames"][1].update(frame=2**63), "far outside of the clip"),
    "image outside": (lambda d: d["frames"][0].update(file_path="../../etc/passwd"), "outside"),
    "image missing": (lambda d: d["frames"][0].update(file_path="no.png"), "missing"),
    "passes missing": (lambda d: d["frames"][0].update(exr_path="no.exr"), "missing"),
}


@pytest.mark.parametrize("case", WRONG)
def test_damage_is_named(tmp_path, case):
    change, word = WRONG[case]
    broken(tmp_path / "a", change)
    with pytest.raises(InputError) as e:
        sq.read_sequence(tmp_path / "a")
    sentence(e, str(tmp_path / "a"), word)


def test_missing_folder_is_named(tmp_path):
    with pytest.raises(InputError) as e:
        sq.read_sequence(tmp_path / "nothing")
    sentence(e, "nothing", "no such file")


def test_damaged_pictures_are_named(tmp_path):
    seq = make(tmp_path / "a")
    (tmp_path / "a" / "0.png").write_bytes(b"not a png")
    image_files.write_png(tmp_path / "a" / "1.png", np.zeros((9, 9, 4), np.uint8))
    (tmp_path / "a" / "2.png").unlink()
    for i, word in enumerate(("cannot be read", "9x9", "missing")):
        with pytest.raises(InputError) as e:
            seq.load_image(i)
        sentence(e, f"{i}.png", word)


def test_damaged_passes_are_named(tmp_path):
    seq = make(tmp_path / "a", frames=5)
    folder = tmp_path / "a"
    (folder / "0.exr").write_bytes((folder / "0.exr").read_bytes()[:200])
    image_files.write_exr(folder / "1.exr", {"Z": np.zeros((4, 6), np.float32)})
    write_passes(folder / "2.exr", Passes(np.ones((2, 2)), *np.zeros((2, 2, 2, 2))))
    write_passes(folder / "3.exr", Passes(np.full((4, 6), np.nan), *np.zeros((2, 4, 6, 2))))
    (folder / "4.exr").unlink()
    for i, word in enumerate(("cannot be read", "channel", "2x2", "NaN", "is missing")):
        with pytest.raises(InputError) as e:
            seq.load_passes(i)
        sentence(e, f"{i}.exr", word)
    with pytest.raises(InputError) as e:
        make(tmp_path / "b", passes=False).load_passes(0)
    sentence(e, "no depth pass")


def test_a_failed_write_leaves_nothing_and_keeps_the_old(tmp_path):
    seq = make(tmp_path / "a")
    before = (tmp_path / "a" / "transforms.json").read_bytes()

    def fail(tmp):
        (tmp / "0.png").write_bytes(b"half")
        raise KeyboardInterrupt

    for name in ("a", "new"):
        with pytest.raises(KeyboardInterrupt):
            sq.write_sequence(seq, tmp_path / name, fail)
    assert [p.name for p in tmp_path.iterdir()] == ["a"]
    assert (tmp_path / "a" / "transforms.json").read_bytes() == before


def test_a_folder_that_is_no_sequence_is_never_replaced(tmp_path):
    seq = make(tmp_path / "a")
    (tmp_path / "holiday").mkdir()
    (tmp_path / "holiday" / "photo.jpg").write_bytes(b"dear")
    with pytest.raises(InputError) as e:
        sq.write_sequence(seq, tmp_path / "holiday", lambda tmp: None)
    sentence(e, "holiday", "not overwritten")
    assert (tmp_path / "holiday" / "photo.jpg").read_bytes() == b"dear"
    make(tmp_path / "a", frames=2)  # an older Sequence is
    assert len(sq.read_sequence(tmp_path / "a").views) == 2
