# SPDX-License-Identifier: GPL-3.0-or-later
import pytest

from timesplat.model.io.ply import write_ply

from ..helpers import make


@pytest.fixture
def folder(tmp_path):
    folder = tmp_path / "files"
    folder.mkdir()
    write_ply(folder / "in.ply", make(120))
    return folder
