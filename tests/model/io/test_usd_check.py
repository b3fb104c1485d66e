# SPDX-License-Identifier: GPL-3.0-or-later
"""USD: what the checks complain about."""

import numpy as np
import pytest

pytest.importorskip("pxr")
from pxr import Sdf, Usd, Vt

from timesplat.model.io.usd_check import check_usd
from timesplat.model.io.usd_write import write_usd

from ...assets import make_asset
from ...usd_helpers import open_splats


@pytest.mark.parametrize(
    ("attribute", "edit", "word"),
    [
        ("scales", lambda v: v[:-1], "39 values for 40"),
        ("scales", lambda v: -v, "not positive"),
        ("orientations", lambda v: v * 2, "unit length"),
        ("opacities", lambda v: v + 1, "leaves 0..1"),
        ("radiance:sphericalHarmonicsCoefficients", lambda v: v[:-1], "39 values"),
        ("primvars:gs4d:mu_t", lambda v: v * np.nan, "NaN"),
        ("extent", lambda v: v * 0.1, "leave the extent"),
        ("positions", lambda v: v[:0], "empty"),
        ("positions", lambda v: v * 0.5, "positions and points differ"),
        ("primvars:displayOpacity", lambda v: v * 0.5, "opacities and primvars:displayOpacity differ"),
    ],
)
def test_check_usd_complains(tmp_path, attribute, edit, word):
    write_usd(tmp_path / "a.usdc", make_asset(40, speed=0))
    stage, prim = open_splats(tmp_path / "a.usdc")
    at = prim.GetAttribute(attribute)
    code = (at.GetTimeSamples() or [Usd.TimeCode.Default()])[0]
    value = at.Get(code)
    at.Set(type(value).FromNumpy(np.ascontiguousarray(edit(np.array(value)))), code)
    stage.Save()
    assert any(attribute in c or attribute == "extent" for c in check_usd(tmp_path / "a.usdc"))
    assert any(word in c for c in check_usd(tmp_path / "a.usdc"))


def test_check_usd_complains_of_the_stage_and_degree(tmp_path):
    write_usd(tmp_path / "a.usda", make_asset(2))
    stage, prim = open_splats(tmp_path / "a.usda")
    prim.GetAttribute("radiance:sphericalHarmonicsDegree").Set(1)
    halves = prim.CreateAttribute("scalesh", Sdf.ValueTypeNames.Half3Array)
    halves.Set(Vt.Vec3hArray([(1, 1, 1)] * 2))
    for key in ("upAxis", "fallbackPrimTypes", "defaultPrim"):
        stage.ClearMetadata(key)
    stage.Save()
    told = "\n".join(check_usd(tmp_path / "a.usda"))
    for word in ("2 values for 2 Gaussians, 8 belong", "upAxis", "fallbackPrimTypes", "defaultPrim", "scales must be"):
        assert word in told
    assert "UsdValidation" in told
