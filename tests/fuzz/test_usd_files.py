# SPDX-License-Identifier: GPL-3.0-or-later
"""Damaged USD files, each read in a process of its own, as the command line does: a sentence or a sound asset, even
where the library dies."""

import random

import pytest

pytest.importorskip("pxr")

from timesplat.datagen.sequence import InputError
from timesplat.model.io.asset import check
from timesplat.model.io.usd_apart import load_usd_apart
from timesplat.model.io.usd_write import write_usd

from ..assets import make_asset, tracked_asset
from .damage import damaged, is_a_sentence


def check_files(folder, seeds) -> None:
    sound = {}
    for suffix in (".usdc", ".usda", ".usdz"):
        for n, asset in enumerate((make_asset(5), tracked_asset(5))):
            write_usd(folder / f"whole{suffix}", asset)
            sound[suffix, n] = (folder / f"whole{suffix}").read_bytes()
    for seed in seeds:
        r = random.Random(seed)
        suffix, n = r.choice(sorted(sound))
        data = sound[suffix, n]
        path = folder / f"damaged{suffix}"
        # of binary files the tables at the end say what lies where
        path.write_bytes(damaged(data, r) if r.random() < 0.5 else damaged(data[::-1], r)[::-1])
        try:
            asset = load_usd_apart(path).asset
        except InputError as e:
            is_a_sentence(e, path)
        else:
            check(asset, path)


def test_damaged_files(tmp_path):
    check_files(tmp_path, range(6))


@pytest.mark.slow
def test_damaged_files_by_the_hundred(tmp_path):
    check_files(tmp_path, range(100, 1000))
