# SPDX-License-Identifier: GPL-3.0-or-later
"""USD: the original object as the other variant."""

import copy
import re
import zipfile

import numpy as np
import pytest

pytest.importorskip("pxr")
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdUtils

from timesplat.datagen.sequence import InputError
from timesplat.model.io.asset import Asset, Clip
from timesplat.model.io.usd_check import check_usd
from timesplat.model.io.usd_read import read_usd
from timesplat.model.io.usd_write import write_usd

from ...assets import make_asset
from ...usd_helpers import make_original

CLIP = Clip(24.0, 0, 23, 1.5, (1.0, 2.0, 3.0), pixel=0.01)


@pytest.fixture(scope="module")
def fox() -> Asset:
    return make_asset(clip=CLIP)


@pytest.mark.parametrize("suffix", [".usdc", ".usda", ".usdz"])
@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("mode", ["splats", "points"])
def test_the_original_lies_over_the_reconstruction(tmp_path, fox, suffix, packed, mode):
    (tmp_path / "in").mkdir()
    original = make_original(tmp_path / "in")
    if packed:
        assert UsdUtils.CreateNewUsdzPackage(str(original), str(original.with_suffix(".usdz")))
        original = original.with_suffix(".usdz")
    out = tmp_path / "out" / f"a{suffix}"
    write_usd(out, fox, mode=mode, original=original)
    assert [p.name for p in out.parent.iterdir()] == [out.name]
    assert check_usd(out) == [] and read_usd(out).clip == fox.clip
    if suffix == ".usdz":  # is whole by itself
        (tmp_path / "in").rename(tmp_path / "gone")
    stage = Usd.Stage.Open(str(out))
    assert stage.GetPrimAtPath("/timesplat/splats") and not stage.GetPrimAtPath("/timesplat/original")
    choice = stage.GetDefaultPrim().GetVariantSet("representation")
    assert choice.GetVariantSelection() == "reconstruction"
    assert choice.GetVariantNames() == ["original", "reconstruction"]
    choice.SetVariantSelection("original")
    assert not stage.GetPrimAtPath("/timesplat/splats")
    mesh = stage.GetPrimAtPath("/timesplat/original/object/mesh")
    assert mesh.GetTypeName() == "Mesh"
    for frame in (0, 11.5, 23):  # (x, y, z) of a Y-up stage in centimetres is (x, -z, y) / 100
        matrix = UsdGeom.XformCache(frame).GetLocalToWorldTransform(mesh)
        np.testing.assert_allclose(matrix.Transform(Gf.Vec3d(0, 1, 0)), (frame / 100, 0, 0.08), atol=1e-9)
    texture = stage.GetPrimAtPath("/timesplat/original/object/red/image").GetAttribute("inputs:file").Get()
    assert texture.resolvedPath.endswith("red.png" if suffix != ".usdz" and not packed else "red.png]")
    assert UsdShade.MaterialBindingAPI(mesh).ComputeBoundMaterial()[0]


def test_an_original_that_counts_from_another_frame(tmp_path, fox):
    scene = make_original(tmp_path)
    with pytest.raises(InputError, match="nan: the frame at which the original starts must be a number"):
        write_usd(tmp_path / "a.usdc", fox, original=scene, original_start=float("nan"))
    write_usd(tmp_path / "a.usdc", fox, original=scene, original_start=10)
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    stage.GetDefaultPrim().GetVariantSet("representation").SetVariantSelection("original")
    mesh = stage.GetPrimAtPath("/timesplat/original/object/mesh")
    matrix = UsdGeom.XformCache(2.5).GetLocalToWorldTransform(mesh)
    np.testing.assert_allclose(matrix.ExtractTranslation(), (0.125, 0, 0.07), atol=1e-9)


def test_originals_that_cannot_be_used(tmp_path, fox):
    def refused(original, word, out="a.usdz"):
        with pytest.raises(InputError, match=re.escape(word)) as e:
            write_usd(tmp_path / out, fox, original=original)
        assert "\n" not in str(e.value) and str(original) in str(e.value) and not (tmp_path / "a.usdz").exists()

    home = tmp_path / "home"
    home.mkdir()
    scene = make_original(home)
    refused(tmp_path / "none.usd", "no such file")
    bad = tmp_path / "bad.usdc"
    bad.write_bytes(b"PXR-USDC" + bytes(100))
    refused(bad, "damaged or not a USD file")
    refused(scene, "is the original itself", "home/scene.usda")
    layer = Sdf.Layer.FindOrOpen(str(scene))
    image = layer.GetAttributeAtPath("/world/red/image.inputs:file")
    (tmp_path / "secret").write_text("x")
    (home / "secret").write_text("x")
    for path, word in (("../secret", "outside of its own folder"), ("./secret", "has no place in a .usdz")):
        image.default = Sdf.AssetPath(path)
        layer.Save()
        refused(scene, word)
    layer.subLayerPaths.append("../bad.usda")
    layer.Save()
    (tmp_path / "bad.usda").write_text("#usda 1.0\n")
    refused(scene, "outside of its own folder")
    layer.subLayerPaths.clear()
    image.default = Sdf.AssetPath("./missing.png")
    layer.Save()
    refused(scene, "missing.png, which is not there")
    write_usd(tmp_path / "b.usdc", fox, original=scene)
    assert any("missing.png" in c for c in check_usd(tmp_path / "b.usdc"))
    layer.defaultPrim = ""
    layer.pseudoRoot.SetInfo("metersPerUnit", -1.0)
    layer.Save()
    refused(scene, "metersPerUnit is -1")
    Sdf.CreatePrimInLayer(layer, "/other").specifier = Sdf.SpecifierDef
    layer.Save()
    refused(scene, "no default prim")
    (tmp_path / "bad.usdz").write_bytes(b"PK\x03\x04 and so on")
    refused(tmp_path / "bad.usdz", "damaged")
    bomb = tmp_path / "bomb.usdz"
    assert UsdUtils.CreateNewUsdzPackage(str(make_original(tmp_path)), str(bomb))
    with zipfile.ZipFile(bomb, "a") as z:  # the same bytes under many names
        for k in range(50):
            z.filelist.append(copy.copy(z.filelist[0]))
            z.filelist[-1].filename = f"{k}.usda"
        z._didModify = True
    refused(bomb, "its files overlap")


def test_a_variant_whose_original_is_gone_is_complained_of(tmp_path, fox):
    scene = make_original(tmp_path)
    write_usd(tmp_path / "a.usdc", fox, original=scene)
    scene.unlink()
    told = check_usd(tmp_path / "a.usdc")
    assert "scene.usda" in "\n".join(told) and "the variant original is empty" in told
