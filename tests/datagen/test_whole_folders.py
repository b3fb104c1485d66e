# SPDX-License-Identifier: GPL-3.0-or-later
import pytest

from timesplat.datagen.whole_folders import write_whole


def test_a_file_is_whole_or_as_it_was(tmp_path):
    path = tmp_path / "new" / "table.csv"
    assert write_whole(path, b"one") == path and path.read_bytes() == b"one"
    (path.with_name(".table.csv.tmp")).mkdir()  # in the way
    with pytest.raises(OSError):
        write_whole(path, b"two")
    assert path.read_bytes() == b"one"
    path.with_name(".table.csv.tmp").rmdir()
    write_whole(path, b"two")
    assert path.read_bytes() == b"two" and [f.name for f in path.parent.iterdir()] == ["table.csv"]
