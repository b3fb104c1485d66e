# SPDX-License-Identifier: GPL-3.0-or-later
"""What numpy pickled is read, and what a pickle would run is not."""

import os
import pickle

import numpy as np
import pytest

from timesplat.datagen.readers.pickled import read_pickled

HELD = {
    "K": [np.arange(9.0).reshape(3, 3), np.eye(3, dtype=np.float32).T],
    "columns": np.asfortranarray(np.arange(6).reshape(2, 3)),
    "big": np.arange(3, dtype=">i4"),
    "names": np.array(["a", "bc"]),
    "objects": np.array([{"x": 1}, None], object),
    "one": np.float64(2.5),
    "plain": [1, "two", b"three", (4, None)],
}


@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
def test_numbers_lists_and_text(tmp_path, protocol, monkeypatch):
    path = tmp_path / "x.npy"
    dump = pickle.dump
    monkeypatch.setattr(pickle, "dump", lambda x, file, **_: dump(x, file, protocol=protocol))
    np.save(path, HELD, allow_pickle=True)
    found = read_pickled(path)
    assert found.keys() == HELD.keys()
    for key in ("columns", "big"):
        np.testing.assert_array_equal(found[key], HELD[key])
    np.testing.assert_array_equal(found["K"], HELD["K"])
    assert found["objects"] == [{"x": 1}, None] and found["one"] == 2.5
    assert list(found["names"]) == ["a", "bc"] and found["plain"] == [1, "two", b"three", [4, None]]


class Runs:
    def __init__(self, what, *told):
        self.call = what, told

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize(
    "evil",
    [Runs(os.system, "touch ran"), Runs(eval, "1"), Runs(np.fromfile, "x"), Runs(np.dtype, "O"), Runs(exec, "1")],
)
def test_nothing_is_run(tmp_path, monkeypatch, evil):
    monkeypatch.chdir(tmp_path)
    np.save("x.npy", {"cams": evil}, allow_pickle=True)
    if evil.call[0] is np.dtype:
        assert not isinstance(read_pickled(tmp_path / "x.npy")["cams"], np.dtype)
    else:
        with pytest.raises(ValueError, match="which is not run"):
            read_pickled(tmp_path / "x.npy")
    assert not (tmp_path / "ran").exists()


def test_damage(tmp_path):
    path = tmp_path / "x.npy"
    np.save(path, np.zeros(3))
    with pytest.raises(ValueError, match="numbers alone"):
        read_pickled(path)
    np.save(path, HELD, allow_pickle=True)
    whole = path.read_bytes()
    for size in (3, 60, 140, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:size])
        with pytest.raises(ValueError):
            read_pickled(path)
