# SPDX-License-Identifier: GPL-3.0-or-later
"""The hull of masks, drawn into pictures that have none: it holds the object, little more, and nothing elsewhere."""

import copy
import shutil
from dataclasses import replace

import numpy as np
import pytest

from timesplat.datagen.readers import open_sequence
from timesplat.datagen.readers.options import ReadOptions

from .worlds import PLAIN, photograph, shots, write_panoptic

LENS = PLAIN.resized(48, 40)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    rig = [[replace(s, time=t, camera=str(k)) for k, s in enumerate(shots(14, lens=LENS))] for t in (0.0, 1.0)]
    folder = write_panoptic(tmp_path_factory.mktemp("hulls"), rig, held_out={"3", "8"})
    return folder, rig, open_sequence(folder)


def test_it_is_the_object_and_little_more(scene):
    _, rig, seq = scene
    held = seq.select(rig="target")
    assert len(held) == 4
    for i in held:
        v = seq.views[i]
        hull, shown = seq.hull(i), photograph(rig[v.frame][int(v.camera)])[..., 3] > 127
        assert hull.shape == (40, 48) and hull.dtype == np.uint8 and set(np.unique(hull)) == {0, 255}
        assert (hull > 0)[shown].mean() > 0.99, "it holds the object"
        assert (hull > 0)[~shown].mean() < 0.12, "and little more"


def test_only_where_there_is_no_mask(scene):
    _, _, seq = scene
    assert all(seq.hull(i) is None for i in seq.select(rig="train"))


def test_it_follows_its_sequence(scene):
    """Opened again, a Sequence is a copy; what its hulls know goes with it."""
    folder, _, seq = scene
    again, i = open_sequence(folder), seq.select(rig="target")[0]
    assert again is not seq and again.hull.seq is again
    assert (again.hull(i) == seq.hull(i)).all()
    moved = copy.deepcopy(seq)
    for v in moved.views:
        v.frame += 1
    assert moved.hull(seq.select(rig="target")[0]) is not None and seq.views[0].frame == 0


def test_a_moment_with_few_masks_has_none(tmp_path, scene):
    rig = [[replace(s, time=t, camera=str(k)) for k, s in enumerate(shots(9, lens=LENS))] for t in (0.0, 1.0)]
    folder = write_panoptic(tmp_path, rig, held_out={"4"})
    for k in (0, 1, 2, 3, 5, 6):
        (folder / f"seg/{k}/000006.png").unlink()
    seq = open_sequence(folder)
    first, last = (next(i for i in seq.select(rig="target") if seq.views[i].frame == f) for f in (0, 1))
    assert seq.hull(first) is not None and seq.hull(last) is None


def test_all_masks_or_none_need_no_hull(tmp_path):
    rig = [[replace(s, time=t, camera=str(k)) for k, s in enumerate(shots(6))] for t in (0.0, 1.0)]
    folder = write_panoptic(tmp_path, rig)
    assert open_sequence(folder).hull is None
    shutil.rmtree(folder / "seg")
    assert open_sequence(folder, ReadOptions(scale=1)).hull is None
