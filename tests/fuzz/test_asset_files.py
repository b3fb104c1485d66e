# SPDX-License-Identifier: GPL-3.0-or-later
"""Damaged files of Gaussians: one sentence, or an asset that is sound and that every format takes or refuses."""

import functools
import random
import tempfile
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from timesplat.datagen.sequence import InputError
from timesplat.model.io.asset import check
from timesplat.model.io.files import read_asset, write_asset
from timesplat.model.io.slices import slice_at

from ..assets import make_asset, tracked_asset
from .damage import damaged, is_a_sentence, no_hang, suite

HEAD = "ply\nformat {form} 1.0\nelement vertex 4\n"
COLUMNS = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"]
COLUMNS += ["rot_0", "rot_1", "rot_2", "rot_3"]


@functools.cache
def whole() -> dict[str, tuple[str, bytes]]:
    """{kind: (suffix, bytes)} of sound files."""
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder)
        lines, paths = make_asset(6), tracked_asset(6, (1, 2, 5))

        def made(kind, suffix, asset, **how):
            write_asset(path / f"a{suffix}", asset, **how)
            found[kind] = (suffix, (path / f"a{suffix}").read_bytes())

        made("lines", ".ply", lines)
        made("paths", ".ply", paths)
        made("page", ".html", lines)
        for suffix in (".ply", ".splat", ".spz", ".sog"):
            made(f"slice{suffix}", suffix, lines, frame=20.0)
        if find_spec("fourdgs"):
            made("4dgs", ".4dgs", lines)
    r = np.random.default_rng(0)
    rows = r.normal(0, 0.3, (4, len(COLUMNS)))
    for form in ("ascii", "binary_big_endian"):
        head = HEAD.format(form=form) + "".join(f"property float {c}\n" for c in COLUMNS) + "end_header\n"
        body = "\n".join(" ".join(f"{x:.4f}" for x in row) for row in rows).encode() + b"\n"
        found[form] = (".ply", head.encode() + (body if form == "ascii" else rows.astype(">f4").tobytes()))
    return found


def large(asset) -> float:
    """The largest number in it; .splat files are told from others by there being no monstrous ones."""
    return max(np.abs(x).max() for x in (asset.xyz, asset.velocity, asset.scale))


def check_file(seed: int) -> None:
    r = random.Random(seed)
    suffix, data = whole()[r.choice(sorted(whole()))]
    with tempfile.TemporaryDirectory() as folder, no_hang():
        path = Path(folder) / f"a{suffix}"
        path.write_bytes(damaged(data, r))
        try:
            asset = read_asset(path).asset
        except InputError as e:
            is_a_sentence(e, path)
            return
        check(asset, path)
        time = r.uniform(-1, 1)
        place, opacity = asset.at(time)
        assert (np.isfinite(place).all() and np.isfinite(opacity).all()) or large(asset) > 1e30
        frame = r.choice((asset.clip.frame_start, asset.clip.frame_end))
        for out in (path.with_name(f"b{s}") for s in (".ply", ".html", ".splat", ".spz", ".glb")):
            try:
                write_asset(out, asset, frame=None if out.suffix in (".ply", ".html") else frame)
            except InputError as e:
                is_a_sentence(e, out)
                assert not out.exists(), "half-written"
                continue
            if out.suffix in (".ply", ".html"):
                again = read_asset(out).asset
                assert len(again) == len(asset) and np.array_equal(again.xyz, asset.xyz)
            elif out.suffix == ".spz" or (out.suffix == ".splat" and large(asset) < 1e8):
                check(read_asset(out).asset, out)
        shown = slice_at(asset, frame)
        assert len(shown) <= len(asset)


def test_all_of_it_is_beyond_belief():
    check_file(14760)


test_damaged_files, test_damaged_files_by_the_thousand = suite(check_file, 200)
