# SPDX-License-Identifier: GPL-3.0-or-later
"""`timesplat render --ray`, with a cluster of this machine. Ray is not of what `make setup` installs."""

import importlib.util
import os
import random
import signal
import sys

import pytest

from timesplat import cli
from timesplat.datagen.ray_pool import _own_core
from timesplat.datagen.render_pool import cores

from .killing import KILLS, ZOO, children, survives

with_ray = pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed: the extra `ray`")


def render(*words):
    return cli.main(["render", *map(str, words)])


def test_without_ray_it_is_one_sentence(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "ray", None)
    assert render("--zoo", "0", "--out", tmp_path, "--ray") == 2
    assert capsys.readouterr().err == "timesplat: ray is not installed; pip install 'timesplat[ray]'.\n"
    assert not list(tmp_path.iterdir())


@with_ray
def test_addresses_that_are_none(tmp_path, capsys):
    (tmp_path / "assets").mkdir()
    for wrong in (tmp_path / "assets", "nowhere:x"):
        assert render("--zoo", "0", "--out", tmp_path / "out", "--ray", wrong) == 2
        said = capsys.readouterr().err
        assert str(wrong) in said and said.count("\n") == 1 and ";" in said and not (tmp_path / "out").exists()


@pytest.mark.skipif(os.name != "posix", reason="locks of files")
def test_no_two_workers_have_one_core(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with _own_core() as first, _own_core() as second:
        assert len(first) == 1 and first[0] in cores() and first != second
    with _own_core() as again:
        assert again == first


@with_ray
@pytest.mark.skipif(sys.platform != "linux", reason="/proc")
@pytest.mark.parametrize("kills", [2, pytest.param(KILLS, marks=pytest.mark.slow)])
def test_killed_at_any_moment_it_ends_with_the_same(small_assets, tmp_path, kills):
    """Three of four times it is a worker in the midst of an asset, which Ray replaces; else the run itself."""
    rng = random.Random(kills)

    def kill(process, number):
        workers = sorted({parent for parent in children(tmp_path / "killed").values() if parent > 1})
        if number % 4 == 3:
            process.kill()
            process.wait()
        elif workers:
            os.kill(rng.choice(workers), signal.SIGKILL)
        else:
            return 0  # none renders at this moment
        return 1

    assert survives([small_assets, *ZOO[: kills // 3], "--ray=local"], tmp_path, kills, rng, kill)
