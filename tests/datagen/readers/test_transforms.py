# SPDX-License-Identifier: GPL-3.0-or-later
"""transforms.json: which entry counts where several could. What comes out of it: test_posed."""

import numpy as np
import pytest

from timesplat.datagen.readers.transforms import matrix_of, read_transforms
from timesplat.datagen.sequence import InputError

from .worlds import PLAIN, save, shots, write_transforms


@pytest.fixture
def write(tmp_path):
    for k in range(2):
        save(tmp_path / f"images/{k:04d}.png", np.zeros((20, 24, 3), np.uint8))
    return lambda *words, **top: read_transforms(write_transforms(tmp_path, shots(2), *words, **top))


def test_lenses_at_the_top_and_of_frames(write):
    first, second = (p.lens for p in write(k1=0.1, frame=lambda k, s: {"k1": 0.2, "w": 48} if k else {}).pictures)
    assert (
        first.radial == (0.1, 0, 0, 0) and second.radial == (0.2, 0, 0, 0) and (first.width, second.width) == (24, 48)
    )
    assert write().pictures[0].lens == PLAIN
    pinhole = write(camera_model="PINHOLE", k1=0.1, p1=0.1).pictures[0].lens
    assert pinhole == PLAIN
    fisheye = write(camera_model="OPENCV_FISHEYE", k1=0.1, p1=0.1).pictures[0].lens
    assert fisheye.fisheye and fisheye.tangential == (0, 0)
    brown = write(k4=0.1, p1=0.2, p2=0.3).pictures[0].lens
    assert brown.radial == (0, 0, 0, 0.1) and brown.tangential == (0.2, 0.3) and not brown.divisor


def test_an_angle_in_place_of_a_focal_length(write):
    def change(d):
        del d["fl_x"], d["fl_y"]
        d["camera_angle_x"] = 2 * np.arctan(12 / 26.0)

    lens = write(change).pictures[0].lens
    assert (lens.fx, lens.fy) == pytest.approx((26, 26))


def test_rates_ranges_and_cameras(write):
    scene = write(fps=30, frame_start=1, frame_end=9, frame=lambda k, s: {"camera": 7, "rig": "val"})
    assert (scene.fps, scene.frame_range) == (30, (1, 9)) and {(p.camera, p.rig) for p in scene.pictures} == {
        ("7", "val")
    }
    assert write().frame_range == (None, None) and write().fps is None


def test_matrices():
    assert matrix_of(np.eye(4)[:3]).tolist() == np.eye(4).tolist()
    for shape in ((4, 3), (2, 4), (16,)):
        with pytest.raises(ValueError, match="not 4x4 or 3x4"):
            matrix_of(np.zeros(shape))


def test_damage_is_named(write, tmp_path):
    for change, says in (
        (lambda d: d.update(frames=3), r"transforms\.json: it is damaged"),
        (lambda d: d["frames"][0].pop("file_path"), "the entry 'file_path' is missing"),
        (lambda d: d["frames"][0].update(transform_matrix="x"), "it is damaged"),
        (lambda d: d.update(w="wide"), "it is damaged"),
    ):
        with pytest.raises(InputError, match=says):
            write(change)
