# SPDX-License-Identifier: GPL-3.0-or-later
"""Panoptic's two files: what they say, and damage. What comes out of them: test_posed."""

import json
from dataclasses import replace

import pytest

from timesplat.datagen.readers.panoptic import read_panoptic
from timesplat.datagen.sequence import InputError

from .worlds import shots, write_panoptic


@pytest.fixture
def folder(tmp_path):
    rig = [[replace(s, time=t, camera=str(k)) for k, s in enumerate(shots(3))] for t in (0.0, 1.0)]
    return write_panoptic(tmp_path, rig, held_out={"2"})


def test_what_it_says(folder):
    scene = read_panoptic(folder)
    assert [(p.image, p.frame, p.camera, p.rig) for p in scene.pictures] == [
        ("ims/0/000000.jpg", 0, "0", "train"),
        ("ims/1/000000.jpg", 0, "1", "train"),
        ("ims/0/000006.jpg", 1, "0", "train"),
        ("ims/1/000006.jpg", 1, "1", "train"),
        ("ims/2/000000.jpg", 0, "2", "target"),
        ("ims/2/000006.jpg", 1, "2", "target"),
    ]
    assert [p.mask for p in scene.pictures[::4]] == ["seg/0/000000.png", None]
    assert scene.pictures[0].lens == shots(1 + 1)[0].lens
    (folder / "test_meta.json").unlink()
    assert len(read_panoptic(folder).pictures) == 4


def test_damage_is_named(folder):
    path = folder / "train_meta.json"
    good = json.loads(path.read_text())
    for change, says in (
        ({"k": good["k"][:1]}, "it is damaged"),
        ({"w2c": [[[[1.0]]] * 2] * 2}, "the camera 0 is not a 3x3 and a 4x4 matrix"),
        ({"k": [], "w2c": [], "fn": [], "cam_id": []}, "it has no frames"),
    ):
        path.write_text(json.dumps(good | change))
        with pytest.raises(InputError, match=rf"train_meta\.json: .*{says}"):
            read_panoptic(folder)
    del good["fn"]
    path.write_text(json.dumps(good))
    with pytest.raises(InputError, match=r"train_meta\.json: the entry 'fn' is missing"):
        read_panoptic(folder)
