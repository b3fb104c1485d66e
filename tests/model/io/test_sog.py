# SPDX-License-Identifier: GPL-3.0-or-later
"""PlayCanvas's .sog: what is written is read by its specification in plain loops, and by PlayCanvas's own program where
that is at hand; what is damaged is one sentence."""

import io
import json
import os
import shutil
import subprocess
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from timesplat.datagen.sequence import InputError
from timesplat.model.io import sog as module
from timesplat.model.io.asset import SH_C0, rotation_matrices
from timesplat.model.io.files import read_asset, upright
from timesplat.model.io.slices import slice_at, write_slice
from timesplat.model.io.sog import sog

from ...assets import make_asset, tracked_asset

ASSETS = [make_asset(300, sigma=(9, 10)), tracked_asset(300, turn=0.5)]
PROGRAM = os.environ.get("TIMESPLAT_SPLAT_TRANSFORM") or shutil.which("splat-transform")


def by_the_book(data: bytes) -> dict:
    """A .sog's Gaussians one by one, as the specification says it."""
    bundle = zipfile.ZipFile(io.BytesIO(data))
    meta = json.loads(bundle.read("meta.json"))
    open_ = lambda name: Image.open(io.BytesIO(bundle.read(name)))  # noqa: E731
    names = sorted({f for part in meta.values() if isinstance(part, dict) for f in part.get("files", [])})
    pictures = {name: open_(name).convert("RGBA") for name in names}
    assert {p.size for p in pictures.values()} == {pictures["quats.webp"].size} and meta["version"] == 2
    width, found = pictures["quats.webp"].width, {k: [] for k in ("xyz", "scale", "rotation", "rgb", "opacity")}
    for i in range(meta["count"]):
        at = {name: p.getpixel((i % width, i // width)) for name, p in pictures.items()}
        xyz = []
        for axis in range(3):
            low, high = (meta["means"][k][axis] for k in ("mins", "maxs"))
            n = low + (high - low) * ((at["means_u.webp"][axis] << 8) | at["means_l.webp"][axis]) / 65535
            xyz.append(np.sign(n) * (np.exp(abs(n)) - 1))
        *abc, tag = at["quats.webp"]
        abc = [(c / 255 - 0.5) * 2 / np.sqrt(2) for c in abc]
        abc.insert(tag - 252, np.sqrt(max(0, 1 - sum(c * c for c in abc))))
        found["xyz"].append(xyz)
        found["rotation"].append(abc)
        found["scale"].append([np.exp(meta["scales"]["codebook"][at["scales.webp"][k]]) for k in range(3)])
        found["rgb"].append([0.5 + SH_C0 * meta["sh0"]["codebook"][at["sh0.webp"][k]] for k in range(3)])
        found["opacity"].append(at["sh0.webp"][3] / 255)
    return {k: np.array(v) for k, v in found.items()}


def assert_near(found, part, opacity=0.51) -> None:
    """In any order."""
    nearest = ((found["xyz"][:, None] - part.xyz[None]) ** 2).sum(2).argmin(1)
    assert sorted(nearest) == list(range(len(part)))
    same = part[nearest]
    np.testing.assert_allclose(found["xyz"], same.xyz, atol=1.5e-4)
    np.testing.assert_allclose(np.log(found["scale"]), np.log(same.scale), atol=0.03)
    np.testing.assert_allclose(found["rgb"], same.rgb, atol=0.02)
    np.testing.assert_allclose(found["opacity"], same.opacity, atol=opacity / 255)
    np.testing.assert_allclose(
        rotation_matrices(found["rotation"].astype("f4")), rotation_matrices(same.rotation), atol=0.025
    )


@pytest.mark.parametrize("asset", ASSETS, ids=["lines", "paths"])
def test_it_is_the_slice_by_its_specification(asset):
    part = slice_at(asset, 17.5)
    assert_near(by_the_book(sog(part, 17.5)), part)


@pytest.mark.parametrize("asset", ASSETS, ids=["lines", "paths"])
def test_it_is_read_back_and_stands_upright(tmp_path, asset):
    for suffix in ("ply", "sog"):
        write_slice(tmp_path / f"a.{suffix}", asset, 17.5)
    a, b = (upright(read_asset(tmp_path / f"a.{x}")) for x in ("ply", "sog"))
    assert_near(vars(b), a)
    book = by_the_book((tmp_path / "a.sog").read_bytes())
    np.testing.assert_allclose(read_asset(tmp_path / "a.sog").asset.xyz, book["xyz"], atol=1e-6)


@pytest.mark.parametrize("n", [1, 2, 17, 700])
def test_few_and_equal_gaussians(n):
    part = slice_at(make_asset(n, sigma=(9, 10)), 12, cut=0)
    part = replace(part, scale=np.full_like(part.scale, 0.01), rgb=np.full_like(part.rgb, 0.25))
    found = by_the_book(sog(part, 12.0))
    np.testing.assert_allclose(found["scale"], 0.01, rtol=1e-6)
    np.testing.assert_allclose(found["rgb"], 0.25, atol=1e-6)


def test_the_codebook_is_near_the_best_there_is():
    """Of evenly spread values the best is known: a 256th of the range each."""
    values = np.linspace(0, 1, 100_000)
    levels, which = module._codebook(values)
    missed = np.array(levels)[which] - values
    assert np.sqrt((missed**2).mean()) < 1.02 / 256 / np.sqrt(12)
    bell = np.random.default_rng(0).normal(size=(50_000, 3))
    levels, which = module._codebook(bell)
    distortion = ((np.array(levels)[which] - bell) ** 2).mean()
    assert distortion < 1.2 * np.sqrt(3) * np.pi / 2 / 256**2, "Panter and Dite's of a normal distribution"


def change(data: bytes, **entries) -> bytes:
    """With these files in place of its own."""
    old, out = zipfile.ZipFile(io.BytesIO(data)), io.BytesIO()
    with zipfile.ZipFile(out, "w") as new:
        for name in old.namelist():
            new.writestr(name, entries.get(name.split(".")[0], old.read(name)))
    return out.getvalue()


def test_what_is_damaged_is_a_sentence(tmp_path):
    data = sog(slice_at(ASSETS[0], 17), 17.0)
    meta = json.loads(zipfile.ZipFile(io.BytesIO(data)).read("meta.json"))

    def refused(changed: bytes, says: str) -> None:
        (tmp_path / "a.sog").write_bytes(changed)
        with pytest.raises(InputError, match=f"a\\.sog: .*{says}") as e:
            read_asset(tmp_path / "a.sog")
        assert len(str(e.value).splitlines()) == 1

    refused(data[:-100], "no .sog, or truncated")
    refused(b"", "no .sog, or truncated")
    refused(change(data, meta=b"{"), "damaged")
    refused(change(data, meta=b"[]"), "damaged")
    refused(change(data, meta=json.dumps(meta | {"version": 3})), "version 3, known is 2")
    refused(change(data, meta=json.dumps({k: v for k, v in meta.items() if k != "version"})), "version 1, known is 2")
    refused(change(data, meta=json.dumps(meta | {"count": 10**9})), "claims 1,000,000,000 Gaussians")
    refused(change(data, meta=json.dumps(meta | {"count": 9999})), "pixels for 9999 Gaussians")
    refused(change(data, meta=json.dumps(meta | {"scales": {"codebook": [1.0], "files": ["scales.webp"]}})), "damaged")
    refused(change(data, meta=json.dumps(meta | {"quats": {"files": ["../../etc/passwd"]}})), "damaged")
    refused(change(data, sh0=b"RIFF....WEBPVP8 nothing"), "sh0.webp")
    huge = io.BytesIO()
    Image.new("RGBA", (3000, 3000)).save(huge, "WEBP", lossless=True)
    refused(change(data, quats=huge.getvalue()), "3000 x 3000 pixels for")
    turned = change(data, quats=picture(np.zeros((20, 20, 4), np.uint8)))
    (tmp_path / "a.sog").write_bytes(turned)
    assert (read_asset(tmp_path / "a.sog").asset.rotation == (1, 0, 0, 0)).all(), "tags that are not known do not turn"


def picture(pixels: np.ndarray) -> bytes:
    out = io.BytesIO()
    Image.fromarray(pixels).save(out, "WEBP", lossless=True, exact=True)
    return out.getvalue()


@pytest.mark.skipif(not PROGRAM, reason="npm's @playcanvas/splat-transform is not on PATH")
@pytest.mark.parametrize("asset", ASSETS, ids=["lines", "paths"])
def test_playcanvas_own_program_reads_it_and_we_read_its(tmp_path, asset):
    def transform(*words: str) -> None:
        subprocess.run([PROGRAM, "-q", *words], cwd=tmp_path, check=True, capture_output=True, timeout=120)

    write_slice(tmp_path / "a.sog", asset, 17.5)
    write_slice(tmp_path / "a.ply", asset, 17.5)
    transform("a.sog", "back.ply")
    ours, theirs = read_asset(tmp_path / "a.sog").asset, read_asset(Path(tmp_path / "back.ply")).asset
    for name in ("xyz", "scale", "rgb", "opacity", "rotation"):
        np.testing.assert_allclose(getattr(theirs, name), getattr(ours, name), atol=2e-6, err_msg=name)
    transform("-g", "cpu", "a.ply", "theirs.sog")
    found = vars(read_asset(tmp_path / "theirs.sog").asset)
    assert_near(found, read_asset(tmp_path / "a.ply").asset, opacity=1.01)  # it rounds down
