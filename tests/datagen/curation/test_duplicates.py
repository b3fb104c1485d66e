# SPDX-License-Identifier: GPL-3.0-or-later
import numpy as np

from timesplat.datagen.curation.duplicates import distance, duplicates, small_pictures
from timesplat.datagen.curation.measures import measure

from .drawn import box, draw_sequence


def found(tmp_path, **paints):
    hashes = {}
    for name, paint in paints.items():
        hashes[name] = measure(draw_sequence(tmp_path / name, paint)).hash
    return duplicates(hashes, small_pictures(tmp_path))


def noisy(picture, seed):
    noise = np.random.default_rng(seed).normal(0, 4, (*picture.shape[:2], 3))
    return np.concatenate([np.clip(picture[..., :3] + noise, 0, 255).astype(np.uint8), picture[..., 3:]], -1)


def test_the_same_thing_but_for_noise_is_one_and_other_colours_motions_and_shapes_are_not(tmp_path):
    def walk(t, camera):
        return box(0.3 + 0.3 * t, colour=(200, 120 + 20 * camera, 40))

    twins = found(
        tmp_path,
        a=walk,
        again=lambda t, camera: noisy(walk(t, camera), int(10 * t) + camera),
        blue=lambda t, camera: box(0.3 + 0.3 * t, colour=(40, 120 + 20 * camera, 200)),
        other_motion=lambda t, camera: box(0.3, colour=(200, 120 + 20 * camera, 40), y=0.5 + 0.3 * t),
        tall=lambda t, camera: box(0.3 + 0.3 * t, side=0.6, colour=(200, 120 + 20 * camera, 40)),
        third=walk,
    )
    assert twins == {"again": "a", "third": "a"}


def test_distance():
    assert distance("00" * 32, "ff" + "00" * 31) == 8
    assert distance("0" * 16, "f" + "0" * 15) == 16  # one camera of four
    assert distance("", "") == distance("00", "0000") == float("inf")


def test_what_cannot_be_read_is_no_duplicate(tmp_path):
    assert small_pictures(tmp_path)("gone") is None
    same = {"a": "12345678" * 8, "b": "12345678" * 8, "c": ""}
    assert duplicates(same, lambda name: None) == {}
    assert duplicates(same, lambda name: np.ones((3, 16, 16, 4))) == {"b": "a"}
