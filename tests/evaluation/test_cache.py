# SPDX-License-Identifier: GPL-3.0-or-later
"""What an evaluation keeps: Sequences are found, rows survive a cut, scenes come back as they were."""

import json
import shutil

import torch

from timesplat.datagen.sequence import read_sequence
from timesplat.evaluation.cache import Cache, find_sequences, name_sequences
from timesplat.model.gaussians import FIELDS
from timesplat.model.reconstruct import reconstruct


def test_finished_sequences_are_found(folders, tmp_path):
    sequences, others = find_sequences([str(folders), "fox.glb"])
    assert list(sequences) == ["a", "b"] and others == ["fox.glb"]
    shutil.copytree(folders / "a" / "line", folders / "a" / "turn")
    assert list(find_sequences([str(folders)])[0]) == ["a/line", "a/turn", "b"]
    others = [folders / "x" / "jump", folders / "y" / "jump", folders / "b"]
    assert list(name_sequences(others)) == ["x/jump", "y/jump", "b"]


def test_a_line_that_was_cut_off_is_left_out_and_ended(tmp_path):
    cache = Cache(tmp_path / "out")
    assert cache.rows() == {} and not cache.folder.exists()
    for n in range(3):
        cache.add({"key": str(n), "session": n // 2, "elapsed": 1.0 + n})
    assert set(cache.rows()) == {"0", "1", "2"} and cache.seconds_spent() == 2.0 + 3.0
    text = cache.path.read_text()
    cache.path.write_text(text[:-5])
    cache.add({"key": "3", "session": 0, "elapsed": 1.0})
    assert set(cache.rows()) == {"0", "1", "3"}
    assert [json.loads(x)["key"] for x in cache.path.read_text().splitlines() if x.endswith("}")] == ["0", "1", "3"]


def test_scenes_come_back_as_they_were(sphere_folder, tmp_path):
    cache, g = Cache(tmp_path), reconstruct(read_sequence(sphere_folder), "lift", range(4))
    assert cache.scene("x") is None
    cache.keep_scene("x", g)
    back = cache.scene("x")
    assert all(torch.equal(getattr(back, k), getattr(g, k)) for k in FIELDS)
    cache.keep_scene("y", object())  # another kind of scene
    assert cache.scene("y") is None
