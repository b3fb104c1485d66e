# SPDX-License-Identifier: GPL-3.0-or-later
"""USD read in a process of its own: the same comes back, and what kills the library is a sentence."""

import signal
import sys

import numpy as np
import pytest

pytest.importorskip("pxr")

from timesplat.cli import main
from timesplat.datagen.sequence import InputError
from timesplat.model.io import usd_apart
from timesplat.model.io.files import read_asset
from timesplat.model.io.usd_apart import load_usd_apart
from timesplat.model.io.usd_read import load_usd
from timesplat.model.io.usd_write import write_usd

from ...assets import assert_same, make_asset, tracked_asset

RUN = usd_apart.subprocess.run


@pytest.mark.parametrize("asset", [make_asset(30), tracked_asset(30)], ids=["lines", "paths"])
def test_the_same_comes_back(tmp_path, asset):
    motion = np.tile(np.eye(4), (24, 1, 1))
    motion[:, 0, 3] = np.arange(24)
    path = tmp_path / "a.usdc"
    write_usd(path, asset, motion=motion)
    here, there = load_usd(path), load_usd_apart(path)
    assert_same(here.asset, there.asset)
    assert here.asset.clip == there.asset.clip and (here.up, here.note) == (there.up, there.note)
    assert np.array_equal(here.motion, there.motion)


def test_its_sentences_are_the_same(tmp_path):
    for name, data in (("a.usdc", b"PXR-USDC" + bytes(80)), ("b.usda", b"#usda 1.0\n")):
        (tmp_path / name).write_bytes(data)
        said = []
        for read in (load_usd, load_usd_apart):
            with pytest.raises(InputError) as e:
                read(tmp_path / name)
            said.append(str(e.value))
        assert said[0] == said[1]


def kills(monkeypatch, code):
    """Reading any USD file runs this code in the child."""
    child = [sys.executable, "-c", f"import os, time; {code}"]
    monkeypatch.setattr(usd_apart.subprocess, "run", lambda command, **how: RUN(child, **how))


@pytest.mark.skipif(sys.platform == "win32", reason="it has no such signals")
def test_a_library_that_dies_is_a_sentence(tmp_path, monkeypatch, capsys):
    path = tmp_path / "a.usdc"
    write_usd(path, make_asset(3))
    monkeypatch.delitem(sys.modules, "bpy", raising=False)  # of an earlier test: within Blender it is read as it is
    kills(monkeypatch, f"os.kill(os.getpid(), {int(signal.SIGSEGV)})")
    assert main(["export", str(path), str(tmp_path / "a.ply")]) == 2
    said = capsys.readouterr().err
    assert said == f"timesplat: {path}: the USD library gave up on it (SIGSEGV); it is damaged, export it again.\n"
    assert not (tmp_path / "a.ply").exists()
    kills(monkeypatch, "os._exit(7)")
    with pytest.raises(InputError, match="exit code 7"):
        read_asset(path)


def test_a_library_that_hangs_is_a_sentence(tmp_path, monkeypatch):
    kills(monkeypatch, "time.sleep(60)")
    monkeypatch.setattr(usd_apart, "LONGEST", 0.2)
    with pytest.raises(InputError, match="has not read it"):
        load_usd_apart(tmp_path / "a.usdc")
