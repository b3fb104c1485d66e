# SPDX-License-Identifier: GPL-3.0-or-later
"""Where a Sequence's object is: what is looked at, what decides, and what is said of it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from timesplat.datagen.readers import volume
from timesplat.datagen.readers.backgrounds import Background
from timesplat.datagen.readers.options import ReadOptions
from timesplat.datagen.readers.pictures import Pictures
from timesplat.datagen.readers.placing import looked_at, place, shows_object, silhouettes_of, small_cameras, small_masks
from timesplat.datagen.sequence import InputError, Normalisation, Sequence, View, opengl_to_opencv

from .worlds import PLAIN, photograph, shots

PATH = Path("x.json")


def sequence(taken, picture=photograph, rigs=None):
    """A Sequence in the cameras' own world, whose pictures are taken when they are asked for."""
    lens = taken[0].lens
    seq = Sequence(lens.width, lens.height, 24, 0, len(taken) - 1, provenance={"read": []})
    for k, s in enumerate(taken):
        rig = rigs[k] if rigs else "train"
        seq.views.append(View(k, str(k), rig, s.c2w.copy(), lens.fx, lens.fy, lens.cx, lens.cy, f"{k}"))
    seq.picture = lambda v: picture(taken[int(v.image)])
    return seq


@pytest.fixture(scope="module")
def taken():
    return [replace(s, lens=PLAIN) for s in shots(12)]


def test_what_is_held_out_is_not_looked_at(taken):
    rigs = ["train", "val", "target", "other"] * 3
    views, window = looked_at(sequence(taken, rigs=rigs))
    assert {rigs[i] for i in views} == {"train", "other"} and len(views) == len(window) == 6
    views, _ = looked_at(sequence(taken, rigs=["target"] * 12))  # or nothing would be left
    assert len(views) == 12


def test_cameras_of_smaller_pictures(taken):
    c2w, inside = small_cameras(sequence(taken), [3, 5], 12, 5)
    np.testing.assert_array_equal(c2w, [opengl_to_opencv(taken[k].c2w) for k in (3, 5)])
    np.testing.assert_allclose(inside, [[PLAIN.fx / 2, PLAIN.fy / 4, PLAIN.cx / 2, PLAIN.cy / 4]] * 2)


def test_the_silhouettes_decide(taken):
    seq = sequence(taken)
    place(seq, None, ReadOptions(), PATH)
    low, high = np.array(seq.aabb)
    assert np.abs(np.array(seq.aabb)).max() <= 1 and (low < high).all()
    for v, s in zip(seq.views, taken, strict=True):
        np.testing.assert_allclose(seq.normalisation.to_world(v.c2w), s.c2w, atol=1e-12)
    (said,) = seq.provenance["read"]
    assert said.startswith("volume: the visual hull of 12 silhouettes, ") and "±" in said


def test_masks_that_are_known_are_not_read_again(taken):
    seq, again = sequence(taken), sequence(taken, picture=lambda s: pytest.fail("read"))
    masks = small_masks(seq)
    assert masks.dtype == bool and masks.shape == (12, 80, 96)
    place(seq, None, ReadOptions(), PATH)
    place(again, None, ReadOptions(), PATH, masks)
    assert again.normalisation == seq.normalisation and again.aabb == seq.aabb
    assert (silhouettes_of(again, masks).masks == masks).all()


def test_what_is_said_decides_before_them(taken):
    seq = sequence(taken, picture=lambda s: pytest.fail("read"))
    place(seq, None, ReadOptions(aabb=(0, 0, 0, 2, 1, 1)), PATH)
    assert seq.normalisation.translation == (1, 0.5, 0.5) and "--aabb says" in seq.provenance["read"][0]
    seq = sequence(taken)
    place(seq, None, ReadOptions(scale=5), PATH)
    assert (
        seq.normalisation.scale == 5 and "as large as --scale says, around the silhouettes" in seq.provenance["read"][0]
    )


def nothing_tells(taken):
    """Pictures without alpha, masks or a constant background."""
    seq = sequence(taken)
    pictures = object.__new__(Pictures)
    pictures.background, pictures.has_alpha = None, False
    seq.picture = pictures
    return seq


def test_without_silhouettes_points_or_axes_decide(taken):
    seq = nothing_tells(taken)
    assert not shows_object(seq)
    place(seq, None, ReadOptions(), PATH)
    np.testing.assert_allclose(seq.normalisation.translation, 0, atol=1e-9)
    assert seq.aabb == [[-1, -1, -1], [1, 1, 1]] and "what the cameras look at together" in seq.provenance["read"][0]
    seq, grid = nothing_tells(taken), np.linspace(0.1, 0.3, 5)
    points = np.stack(np.meshgrid(grid, grid, grid), -1).reshape(-1, 3)
    place(seq, np.concatenate([points, [[50, 50, 50]]]), ReadOptions(), PATH)
    np.testing.assert_allclose(seq.normalisation.translation, 0.2, atol=0.01)
    assert "of 126 points" in seq.provenance["read"][0]
    seq = nothing_tells(taken)
    place(seq, points, ReadOptions(scale=3), PATH)
    assert seq.normalisation.scale == 3


def test_a_colour_behind_the_object_shows_it(taken):
    seq = nothing_tells(taken)
    seq.picture.background = Background((255.0, 255.0, 255.0), 1.0)
    assert shows_object(seq) and shows_object(sequence(taken))


def test_refused(taken):
    with pytest.raises(InputError, match=r"x\.json: no picture shows anything of an object"):
        place(sequence(taken, lambda s: np.zeros((20, 24, 4), np.uint8)), None, ReadOptions(), PATH)
    turned = [replace(s, c2w=opengl_to_opencv(s.c2w)) for s in taken]
    pictures = {id(t): photograph(s) for s, t in zip(taken, turned, strict=True)}
    with pytest.raises(InputError, match=r"x\.json: its cameras do not look at one object"):
        place(sequence(turned, lambda s: pictures[id(s)]), None, ReadOptions(), PATH)


def test_silhouettes_that_fit_in_part_are_told(taken, monkeypatch):
    """So is where to look what is wrong."""
    monkeypatch.setattr(volume, "agreement", lambda sil, hull: np.full(len(sil.masks), 0.4))
    seq = sequence(taken)
    place(seq, None, ReadOptions(), PATH)
    assert seq.provenance["read"][0].startswith("only 40% of the silhouettes fit together: `timesplat inspect`")
    assert isinstance(seq.normalisation, Normalisation)
