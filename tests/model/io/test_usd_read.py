# SPDX-License-Identifier: GPL-3.0-or-later
"""USD: stages and files that are not ours, and damaged ones."""

import numpy as np
import pytest

pytest.importorskip("pxr")
from pxr import Gf, Sdf, Usd, UsdGeom

from timesplat.datagen.sequence import InputError
from timesplat.model.io.asset import rotation_matrices, srgb_from_linear
from timesplat.model.io.usd_read import load_usd, read_usd
from timesplat.model.io.usd_stage import SH_COEFFICIENTS, SPLAT_TYPE
from timesplat.model.io.usd_write import write_usd

from ...assets import assert_same, make_asset, tracked_asset
from ...usd_helpers import open_splats, run_child, write_foreign

FUZZ = """
import random, sys
from pathlib import Path
from timesplat.datagen.sequence import InputError
from timesplat.model.io.usd_check import check_usd
from timesplat.model.io.usd_read import read_usd
try:
    import resource
    resource.setrlimit(resource.RLIMIT_AS, (8 << 30, resource.getrlimit(resource.RLIMIT_AS)[1]))
except ImportError:
    pass
source, refused = Path(sys.argv[1]), 0
data = source.read_bytes()
for seed in range(40):
    r, b = random.Random(seed), bytearray(data)
    for _ in range(r.choice((1, 3, 20))):
        b[r.randrange(len(b))] = r.randrange(256)
    if r.random() < 0.2:
        del b[r.randrange(len(b)):]
    path = source.with_name(f"fuzz{seed}{source.suffix}")
    path.write_bytes(b)
    for call in (read_usd, check_usd):
        try:
            call(path)
        except InputError as e:
            refused += 1
            assert chr(10) not in str(e)
print("RESULT" + str(refused))
"""


@pytest.mark.parametrize("asset", [make_asset(30), tracked_asset(30)], ids=["lines", "paths"])
@pytest.mark.parametrize("suffix", [".usdc", ".usda", ".usdz"])
def test_damaged_files_are_refused_or_read(tmp_path, suffix, asset):
    """Nothing but an InputError comes out of 40 damaged copies. (Without a limit to memory the library itself takes
    what a damaged file claims to need.)"""
    write_usd(tmp_path / f"a{suffix}", asset)
    assert int(run_child(FUZZ, tmp_path / f"a{suffix}")) > 10


@pytest.mark.parametrize("half", [False, True])
@pytest.mark.parametrize("degree", [0, 3])
def test_still_splats_of_another_program(tmp_path, half, degree):
    at, sh = write_foreign(tmp_path / "a.usda", half=half, degree=degree)
    asset = read_usd(tmp_path / "a.usda")
    x, y, z = at[None].T * 0.1
    np.testing.assert_allclose(
        asset.xyz * asset.clip.scale + asset.clip.translation, np.stack([x, -z, y], 1), atol=1e-6
    )
    matrices = rotation_matrices(asset.rotation) * (asset.scale * asset.clip.scale)[:, None, :]
    expected = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]) * [0.001, 0.002, 0.003]
    np.testing.assert_allclose(
        matrices @ matrices.transpose(0, 2, 1), [expected @ expected.T] * 3, rtol=2e-3, atol=1e-9
    )
    np.testing.assert_allclose(asset.rgb, 0.5 + 0.28209479 * sh[:: (degree + 1) ** 2], atol=1e-3)
    np.testing.assert_allclose(asset.opacity, [0.5, 0.75, 1])
    np.testing.assert_array_equal(asset.at(1)[0], asset.at(-1)[0])
    np.testing.assert_array_equal(asset.at(1)[1], asset.at(-1)[1])


def test_moving_splats_of_another_program_live_for_a_frame_each(tmp_path):
    at, _ = write_foreign(tmp_path / "a.usda", frames=(3, 5))
    asset = read_usd(tmp_path / "a.usda")
    assert len(asset) == 9 and asset.clip.frames == range(3, 6)
    for frame, expected in ((3, at[3]), (4, (at[3] + at[5]) / 2), (5, at[5])):
        position, opacity = asset.at(asset.frame_to_time(frame))
        seen = opacity > 0.05
        x, y, z = expected.T * 0.1
        world = position[seen] * asset.clip.scale + asset.clip.translation
        np.testing.assert_allclose(world, np.stack([x, -z, y], 1), atol=1e-6)
        np.testing.assert_allclose(opacity[seen], [0.5, 0.75, 1], atol=1e-6)


def test_what_other_programs_leave_out_is_as_the_schema_says(tmp_path):
    whole, bare = tmp_path / "whole.usda", tmp_path / "bare.usda"
    write_foreign(whole)
    write_foreign(bare, scales=1, orientations=1, opacities=1, **{SH_COEFFICIENTS: 1})
    stage = Usd.Stage.Open(str(bare))
    told = read_usd(bare)
    np.testing.assert_array_equal(told.xyz, read_usd(whole).xyz)
    np.testing.assert_allclose(told.scale * told.clip.scale, 0.1, rtol=1e-6)  # a unit is 10 cm
    assert (told.opacity == 1).all() and (told.rgb == 0.5).all()
    colours = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/scan")).CreatePrimvar(
        "displayColor", Sdf.ValueTypeNames.Color3fArray
    )
    for given, interpolation in (([(0.1, 0.2, 0.9)] * 3, "vertex"), ([(0.1, 0.2, 0.9)], "constant")):
        colours.Set(given)
        colours.SetInterpolation(interpolation)
        stage.Save()
        np.testing.assert_allclose(read_usd(bare).rgb, srgb_from_linear(np.array([(0.1, 0.2, 0.9)] * 3)), atol=1e-6)


def test_single_values_of_other_programs_do_not_refuse_the_file(tmp_path):
    """A zero quaternion does not turn, a little more than opaque is opaque, what is no number is left out and named."""
    write_foreign(tmp_path / "a.usda")
    whole = read_usd(tmp_path / "a.usda")
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    prim = stage.GetPrimAtPath("/scan")
    prim.GetAttribute("orientations").Set([Gf.Quatf(0), Gf.Quatf(2), Gf.Quatf(1)])
    prim.GetAttribute("opacities").Set([0.5, 1.0001, 1])
    stage.Save()
    loaded = load_usd(tmp_path / "a.usda")
    np.testing.assert_allclose(loaded.asset.rotation, whole.rotation, atol=1e-6)
    assert loaded.asset.opacity.tolist() == [0.5, 1, 1] and loaded.note == ""
    prim.GetAttribute("opacities").Set([0.5, float("nan"), 7])
    stage.Save()
    loaded = load_usd(tmp_path / "a.usda")
    assert loaded.asset.opacity.tolist() == [0.5, 1]
    assert loaded.note == (
        "1 of 3 Gaussians are left out: NaN, or beyond all bounds, in opacity. "
        "The opacities of 1 Gaussians are clamped to 0..1."
    )


def test_samples_between_frames_are_kept(tmp_path):
    at, _ = write_foreign(tmp_path / "a.usda", frames=(3, 3.5, 4, 5))
    asset = read_usd(tmp_path / "a.usda")
    assert len(asset) == 12 and asset.clip.frames == range(3, 6)
    for frame, expected in at.items():
        position, opacity = asset.at(asset.frame_to_time(frame))
        x, y, z = expected.T * 0.1
        world = position[opacity > 0.05] * asset.clip.scale + asset.clip.translation
        np.testing.assert_allclose(world, np.stack([x, -z, y], 1), atol=1e-6)
        np.testing.assert_allclose(opacity[opacity > 0.05], [0.5, 0.75, 1], atol=1e-6)


@pytest.mark.parametrize(
    ("edit", "word"),
    [
        (lambda stage, prim: prim.RemoveProperty("positions"), "positions is missing at /scan"),
        (lambda stage, prim: prim.GetAttribute("positions").Set([(0, 0, 0)] * 5), "cannot belong to 5 splats"),
        (lambda stage, prim: prim.GetAttribute("positions").Set([]), "cannot belong to 0 splats"),
        (lambda stage, prim: prim.GetAttribute("opacities").Set([float("nan")] * 3), "opacity of all its 3 Gaussians"),
        (lambda stage, prim: prim.RemoveProperty(SH_COEFFICIENTS) and UsdGeom.PrimvarsAPI(prim).CreatePrimvar(
            "displayColor", Sdf.ValueTypeNames.Color3fArray).Set([(0, 0, 0)] * 2), "2 colours cannot belong to 3"),
        (lambda stage, prim: prim.GetAttribute("opacities").Set([1, 1]), "opacity is not a float32 array"),
        (lambda stage, prim: UsdGeom.Xformable(prim).AddScaleOp().Set((0, 1, 1)), "/scan is scaled to nothing"),
        (lambda stage, prim: UsdGeom.Xformable(prim).AddTranslateOp().Set((0, 1, 1), 3), None),
        (lambda stage, prim: [x.Set((0, 1, f), f) for x in [UsdGeom.Xformable(prim).AddTranslateOp()]
                              for f in (2, 3e6)], "its frames run from 2 to 3e+06"),
        (lambda stage, prim: UsdGeom.SetStageMetersPerUnit(stage, -1), "its metersPerUnit is -1"),
        (lambda stage, prim: UsdGeom.SetStageMetersPerUnit(stage, 1e200), "/scan is scaled to nothing"),
        (lambda stage, prim: stage.SetTimeCodesPerSecond(1e300), "fps and scale must be positive"),
        (lambda stage, prim: stage.RemovePrim("/scan") and stage.DefinePrim("/x").GetPayloads().AddPayload("no.usd"),
         "it refers to no.usd, which cannot be opened"),
        (lambda stage, prim: UsdGeom.SetStageMetersPerUnit(stage, float("nan")), "its metersPerUnit is nan"),
        (lambda stage, prim: [prim.GetAttribute("positions").Set([(0, 0, 0)] * 3, f) for f in (0, 1e9)],
         "its frames run from 0 to 1e+09"),
        (lambda stage, prim: stage.DefinePrim("/scan2", SPLAT_TYPE), "holds 2 assets (/scan, /scan2)"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_told_in_a_sentence(tmp_path, edit, word):
    write_foreign(tmp_path / "a.usda")
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    edit(stage, stage.GetPrimAtPath("/scan"))
    stage.Save()
    if word is None:
        assert len(read_usd(tmp_path / "a.usda")) == 3
        return
    with pytest.raises(InputError) as e:
        read_usd(tmp_path / "a.usda")
    assert word in str(e.value) and "a.usda" in str(e.value) and "\n" not in str(e.value)


def test_splats_of_another_program_that_move_as_a_whole(tmp_path):
    """They grow out of nothing while their parent moves: they rest where they are half as large."""
    at, _ = write_foreign(tmp_path / "a.usda")
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    prim = UsdGeom.Xformable(stage.GetPrimAtPath("/scan"))
    shift, size = prim.AddTranslateOp(), prim.AddScaleOp()
    for f in range(5):
        shift.Set((f, 0, 0), 20 + f)
        size.Set((f / 4,) * 3, 20 + f)
    stage.Save()
    loaded = load_usd(tmp_path / "a.usda")
    asset, motion = loaded.asset, loaded.motion
    assert asset.clip.frames == range(20, 25) and len(motion) == 5
    placed = np.c_[asset.xyz * asset.clip.scale + asset.clip.translation, np.ones(3)]
    for f in range(5):
        x, y, z = (at[None] * f / 4 + [f, 0, 0]).T * 0.1
        np.testing.assert_allclose((placed @ motion[f].T)[:, :3], np.stack([x, -z, y], 1), atol=1e-6)
    for f in range(5):  # samples that are all the same are no motion
        shift.Set((3, 0, 0), 20 + f)
        size.Set((1,) * 3, 20 + f)
    stage.Save()
    loaded = load_usd(tmp_path / "a.usda")
    asset, motion = loaded.asset, loaded.motion
    x, y, z = (at[None] + [3, 0, 0]).T * 0.1
    np.testing.assert_allclose(
        asset.xyz * asset.clip.scale + asset.clip.translation, np.stack([x, -z, y], 1), atol=1e-6
    )
    assert motion is None


def test_files_from_before_gs4d_time_are_read(tmp_path):
    asset = make_asset(40)
    write_usd(tmp_path / "a.usdc", asset)
    stage, prim = open_splats(tmp_path / "a.usdc")
    prim.RemoveProperty("gs4d:time")
    stage.Save()
    assert read_usd(tmp_path / "a.usdc").clip == asset.clip


def test_a_mirrored_asset_is_read_as_it_is_seen(tmp_path):
    asset = make_asset(40)
    write_usd(tmp_path / "a.usdc", asset)
    stage, _ = open_splats(tmp_path / "a.usdc")
    UsdGeom.Xformable(stage.GetDefaultPrim()).AddScaleOp().Set((-1, 2, 1))
    stage.Save()
    back = read_usd(tmp_path / "a.usdc")
    np.testing.assert_allclose(
        back.xyz * back.clip.scale + back.clip.translation, (asset.xyz * 2 + [1, 2, 3]) * [-1, 2, 1], atol=1e-5
    )
    before = rotation_matrices(asset.rotation) * asset.soft_scale()[:, None] * [[[-2], [4], [2]]]
    after = rotation_matrices(back.rotation) * back.soft_scale()[:, None] * back.clip.scale
    np.testing.assert_allclose(after @ after.transpose(0, 2, 1), before @ before.transpose(0, 2, 1), atol=1e-6)


@pytest.mark.parametrize(
    ("name", "value", "word"),
    [
        ("primvars:gs4d:path", None, "paths that are not there|is missing"),
        ("primvars:gs4d:path", [7] * 30, "paths that are not there"),
        ("primvars:gs4d:path", [-1] * 30, "paths that are not there"),
        ("primvars:gs4d:path", [0] * 29, "paths that are not there"),
        ("gs4d:paths:start", None, "gs4d:paths:start is missing"),
        ("gs4d:paths:start", [2] * 4, "end before they start"),
        ("gs4d:paths:end", [float("nan")] * 4, "end is not a float32 array"),
        ("gs4d:paths:end", [1] * 3, "end is not a float32 array"),
        ("gs4d:paths:knots", [1, 2, 5, 25], "damaged|place is not"),
        ("gs4d:paths:knots", [1, 2, 5, -24], "damaged"),
        ("gs4d:paths:knots", [0, 3, 5, 24], "paths without knots"),
        ("gs4d:paths:place", [(0, 0, 0)] * 31, "place is not a float32 array"),
        ("gs4d:paths:rotation", None, "gs4d:paths:rotation is missing"),
    ],
)
def test_damaged_paths_are_told_in_a_sentence(tmp_path, name, value, word):
    write_usd(tmp_path / "a.usda", tracked_asset(30))
    stage, prim = open_splats(tmp_path / "a.usda")
    if value is None:
        prim.GetAttribute(name).Clear()
    else:
        prim.GetAttribute(name).Set(value)
    stage.Save()
    with pytest.raises(InputError, match=word) as e:
        read_usd(tmp_path / "a.usda")
    assert "a.usda" in str(e.value) and "\n" not in str(e.value)


def test_paths_in_a_shot_that_is_placed_and_retimed(tmp_path):
    """Turned by a right angle, moved, two and a half times as slow: where the stage has it, when the stage has it."""
    asset = tracked_asset(40, turn=0.5)
    write_usd(tmp_path / "a.usdc", asset)
    stage = Usd.Stage.CreateNew(str(tmp_path / "shot.usda"))
    UsdGeom.SetStageUpAxis(stage, "Z")
    UsdGeom.SetStageMetersPerUnit(stage, 1)
    stage.SetTimeCodesPerSecond(30)
    shot = stage.DefinePrim("/fox", "Xform")
    shot.GetReferences().AddReference("./a.usdc", layerOffset=Sdf.LayerOffset(100, 2.5))
    UsdGeom.Xformable(shot).AddTranslateOp().Set((5, 0, 0))
    UsdGeom.Xformable(shot).AddRotateZOp().Set(90)
    stage.Save()
    back = read_usd(tmp_path / "shot.usda")
    for frame in (10, 16.4, 33):
        want, opacity = asset.at(asset.frame_to_time(frame))
        got, seen = back.at(back.frame_to_time(100 + 2.5 * frame))
        want = (want * 2 + [1, 2, 3]) @ [[0, 1, 0], [-1, 0, 0], [0, 0, 1]] + [5, 0, 0]
        np.testing.assert_allclose(got * back.clip.scale + back.clip.translation, want, atol=1e-4)
        np.testing.assert_allclose(seen, opacity, atol=1e-6)


def test_what_rides_on_paths_is_written_again_as_it_was(tmp_path):
    write_usd(tmp_path / "a.usdc", tracked_asset(30))
    write_usd(tmp_path / "b.usdc", read_usd(tmp_path / "a.usdc"))
    assert_same(read_usd(tmp_path / "a.usdc"), read_usd(tmp_path / "b.usdc"), 1e-6, 1e-6)
