# SPDX-License-Identifier: GPL-3.0-or-later
"""Files are written whole or not at all."""

import os

import pytest

from timesplat.datagen.sequence import InputError
from timesplat.model.io.ply import write_ply

from ...assets import make_asset


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    write_ply(tmp_path / "a.ply", make_asset(3))
    before = (tmp_path / "a.ply").read_bytes()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(InputError, match=r"a\.ply.*No space left"):
        write_ply(tmp_path / "a.ply", make_asset(4))
    assert (tmp_path / "a.ply").read_bytes() == before and os.listdir(tmp_path) == ["a.ply"]


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(InputError, match=r"a\.ply: it cannot be written"):
        write_ply(tmp_path / "file" / "a.ply", make_asset(3))
