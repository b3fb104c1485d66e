# SPDX-License-Identifier: GPL-3.0-or-later
"""Stages are opened with care, or it is said why not."""

import sys

import pytest

from timesplat.datagen.sequence import InputError
from timesplat.model.io.files import read_asset, write_asset
from timesplat.model.io.usd_stage import USD_SUFFIXES, metres_per_unit, open_stage, reading, select

from ...assets import make_asset


@pytest.mark.parametrize("suffix", USD_SUFFIXES)
def test_where_there_is_no_usd_library_it_is_named(tmp_path, suffix, monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr", None)
    for call in (read_asset, lambda path: write_asset(path, make_asset())):
        with pytest.raises(InputError, match=r"lacks usd-core, which USD files need; install timesplat\[usd\]"):
            call(tmp_path / f"a{suffix}")


def test_what_the_library_raises_becomes_a_sentence(tmp_path):
    pytest.importorskip("pxr")
    (tmp_path / "a.usda").write_text("nothing of the kind")
    with pytest.raises(InputError, match=r"a\.usda: it is damaged or not a USD file"), reading(tmp_path / "a.usda"):
        open_stage(tmp_path / "a.usda")
    with pytest.raises(InputError, match=r"b\.usda: no such file"), reading(tmp_path / "b.usda"):
        open_stage(tmp_path / "b.usda")


def test_variants_are_selected_for_the_opened_stage_alone(tmp_path):
    Usd = pytest.importorskip("pxr.Usd")
    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    assert not select(stage, "original")
    choice = stage.DefinePrim("/a").GetVariantSets().AddVariantSet("representation")
    choice.AddVariant("original")
    assert select(stage, "original") and choice.GetVariantSelection() == "original"
    stage.Save()
    assert 'string representation = "original"' not in (tmp_path / "a.usda").read_text()


def test_units_are_positive(tmp_path):
    Usd, UsdGeom = pytest.importorskip("pxr.Usd"), pytest.importorskip("pxr.UsdGeom")
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, 0.25)
    assert metres_per_unit(stage, tmp_path) == 0.25
    for wrong in (0.0, float("nan"), -1):
        UsdGeom.SetStageMetersPerUnit(stage, wrong)
        with pytest.raises(InputError, match="set it to a positive number"):
            metres_per_unit(stage, tmp_path)
