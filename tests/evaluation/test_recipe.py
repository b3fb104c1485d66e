# SPDX-License-Identifier: GPL-3.0-or-later
"""The comparison with the field's recipe: what is counted, and where two PSNR are equal."""

import importlib.util
import json

import pytest

from timesplat.benchmarks.recipe import TRUTH
from timesplat.datagen.sequence import InputError
from timesplat.evaluation import recipe


def row(way: str, psnr: float, image: float, once: float = 0.0) -> dict:
    return {"object": "a", "way": way, "psnr": psnr, "image": image, "images": 4, "total": once + 4 * image}


def test_what_is_done_once_an_object_is_shared_by_its_images():
    assert recipe.seconds_an_image(row("ours, 4", 30, 0.5, once=14.4)) == pytest.approx(0.6)


def test_seconds_at_equal_psnr_lie_between_numbers_of_samples():
    rows = [row("ours, 4", 30, 0.1), row("ours, 16", 40, 0.4), row("TRELLIS", 35, 2.0)]
    assert recipe.ours_at(rows, 35) == pytest.approx(0.2)  # straight in log seconds
    assert recipe.ours_at(rows, 20) == pytest.approx(0.1) and recipe.ours_at(rows, 40.1) == pytest.approx(0.4)
    assert recipe.ours_at(rows, 40.3) is None


def test_gains_are_those_of_images_a_second(monkeypatch):
    rows = [row("ours, 4", 30, 0.1), row("ours, 16", 40, 0.4)]
    rows += [row("TRELLIS", 35, 2.0), row("Objaverse-XL", 30, 0.8), row("16 samples alone", 41, 1.0)]
    rows += [row("128 samples alone", 50, 1.0)]
    gains = recipe.gains(rows)
    assert gains["TRELLIS"] == pytest.approx(10) and gains["Objaverse-XL"] == pytest.approx(8)
    assert gains["128 samples alone"] is None


@pytest.mark.skipif(not importlib.util.find_spec("bpy"), reason="bpy is not installed")
def test_all_ways_see_the_same_views(tmp_path):
    for way in ("16 samples alone", "ours, 16"):
        recipe._measure("zoo:3", way, 32, tmp_path / way, recipe.cores()[0])
    result = json.loads((tmp_path / "16 samples alone" / "result.json").read_text())
    assert result["images"] == 4 and 0 < result["image"] < result["total"]
    assert {"scene", "samples", "PNG"} <= set(result["stages"])
    # a camera, light, frame or colour that differed would be far below; noise of 16 samples is not
    assert recipe.psnr(tmp_path / "16 samples alone", tmp_path / "ours, 16") > 30


def test_an_asset_that_cannot_be_opened_is_named(tmp_path):
    pytest.importorskip("bpy")
    with pytest.raises(InputError, match=r"no\.glb: truth could not be measured: .*no such file"):
        recipe._measure(str(tmp_path / "no.glb"), TRUTH, 32, tmp_path / "out", recipe.cores()[0])
