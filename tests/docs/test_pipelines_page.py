# SPDX-License-Identifier: GPL-3.0-or-later
"""docs/pipelines.md does what it says: its commands, its Python, its snippets of USD; under usd-core, under the
older pxr inside of the bpy wheel, in Blender's importer and in a reader that is not OpenUSD."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pxr")
from pxr import Gf, Sdf, Usd, UsdGeom

from timesplat.cli import main
from timesplat.model.io.asset import ARRAYS, Asset, Clip, rotation_matrices
from timesplat.model.io.ply import read_ply, write_ply
from timesplat.model.io.usd_check import check_usd
from timesplat.model.io.usd_read import read_usd
from timesplat.model.io.usd_write import write_usd

from ..assets import make_asset
from ..usd_helpers import make_original, run_child

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "pipelines.md").read_text()
CLIP = Clip(24.0, 0, 23, 1.5, (1.0, 2.0, 3.0), pixel=0.01)
SHOTS = dict(re.findall(r"```usda (\S+)\n(.*?)```", PAGE, re.S))
FILES = ("fox.usdc", "fox_points.usdc", "fox_frames.usdc", "fox.usdz")
PLACES = {  # where the page says the assets are: path of the splats -> offset, scale of time, 4x4 matrix
    "shot.usda": {"/shot/fox/splats": (1001, 2, Gf.Matrix4d().SetRotate(Gf.Rotation((0, 0, 1), 90)), (5, 0, 0))},
    "sublayer.usda": {"/timesplat/splats": (100, 1, Gf.Matrix4d(1), (0, 0, 2))},
    "crowd.usda": {
        "/crowd/a/splats": (0, 1, Gf.Matrix4d(1), (-2, 0, 0)),
        "/crowd/b/splats": (0, 1, Gf.Matrix4d(1), (2, 0, 0)),
        "/crowd/c/splats": (0, 1, Gf.Matrix4d(1), (0, 0, 0)),
    },
    "centimetres.usda": {
        "/shot/fox/splats": (0, 1, Gf.Matrix4d(100, 0, 0, 0, 0, 0, -100, 0, 0, 100, 0, 0, 0, 0, 0, 1), (0, 0, 0))
    },
}


def world(asset: Asset, frame: float, turn: Gf.Matrix4d, shift: tuple) -> np.ndarray:
    """Where the page says the Gaussians are at a frame of the clip."""
    p = asset.at(asset.frame_to_time(frame))[0] * asset.clip.scale + asset.clip.translation
    return p @ np.array(turn)[:3, :3] + shift


@pytest.fixture(scope="module")
def fox() -> Asset:
    return make_asset(clip=CLIP)


@pytest.fixture(scope="module")
def page(tmp_path_factory, fox) -> Path:
    """A folder in which the page's commands were run and to which its snippets were written."""
    folder = tmp_path_factory.mktemp("page")
    write_ply(folder / "fox.ply", fox)
    make_original(folder)
    for extra in ("fourdgs", "av"):
        pytest.importorskip(extra)
    lines = [line.split("#")[0] for line in PAGE.splitlines() if re.match(r"timesplat (export|video) \w", line)]
    commands = [line.split()[1:] for line in lines if "--camera" not in line]
    assert [sum(c[0] == name for c in commands) for name in ("export", "video")] == [11, 2]
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for command in commands:
            assert main(command) == 0, command
        for name, text in SHOTS.items():
            Path(name).write_text(text)
    return folder


@pytest.mark.parametrize(
    ("command", "word"),
    [
        ("fox.ply", "name one file to write, or a folder"),
        ("fox.ply a.usdc --sequence b", "name one file to write, or a folder"),
        ("fox.ply a.ply --half", "a.ply: --mode, --half, --original and --check are for USD"),
        ("fox.ply a.usdc --frame 3", "--frame is for one moment's file"),
        ("fox.ply a.obj", "a.obj: cannot write that"),
        ("fox.ply a.usdz --original none.usd", "none.usd: no such file"),
        ("scene.usda a.ply", "scene.usda: no prim is a ParticleField3DGaussianSplat"),
    ],
)
def test_exports_that_cannot_be_say_why(page, capsys, monkeypatch, command, word):
    monkeypatch.chdir(page)
    assert main(["export", *command.split()]) == 2
    told = capsys.readouterr().err
    assert word in told and len(told.splitlines()) == 1
    assert not [f for f in page.iterdir() if f.stem == "a"]


def test_check_decides_the_exit_code(page, tmp_path, monkeypatch, capsys):
    """An original that is looked for where it is not: said, and with --check the command fails."""
    scene = make_original(tmp_path)
    layer = Sdf.Layer.FindOrOpen(str(scene))
    layer.GetAttributeAtPath("/world/red/image.inputs:file").default = Sdf.AssetPath("./no.png")
    layer.Save()
    command = ["export", str(page / "fox.ply"), str(tmp_path / "a.usdc"), "--original", str(scene)]
    assert (main(command), main([*command, "--check"])) == (0, 1)
    assert "no.png" in capsys.readouterr().out


def test_the_commands_wrote_what_the_page_says(page, fox):
    back = read_ply(page / "back.ply")
    assert back.clip == replace(fox.clip)
    for name in ARRAYS:
        np.testing.assert_allclose(getattr(back, name), getattr(fox, name), atol=3e-6, err_msg=name)
    assert len(list((page / "fox_frames").iterdir())) == 24 and (page / "frame12.ply").is_file()
    stage = Usd.Stage.Open(str(page / "fox_frames.usdc"))
    prim = stage.GetPrimAtPath("/timesplat/splats")
    for name in ("positions", "points", "opacities", "widths"):
        assert prim.GetAttribute(name).GetTimeSamples() == list(range(24)), name
    for frame in (0, 7, 23):
        expected, opacity = fox.at(fox.frame_to_time(frame))
        seen = opacity > 0.001
        np.testing.assert_allclose(np.array(prim.GetAttribute("positions").Get(frame))[seen], expected[seen], atol=1e-6)


@pytest.mark.parametrize("name", SHOTS)
def test_the_snippets_are_valid(page, name):
    assert check_usd(page / name) == []


@pytest.mark.parametrize("name", PLACES)
def test_the_snippets_place_and_retime(page, fox, name):
    stage = Usd.Stage.Open(str(page / name))
    for path, (offset, stretch, turn, shift) in PLACES[name].items():
        prim = stage.GetPrimAtPath(path)
        base = prim.GetAttribute("positions" if prim.HasAttribute("positions") else "points")
        for frame in (0, 11.5, 23):
            code = offset + stretch * frame
            matrix = np.array(UsdGeom.XformCache(code).GetLocalToWorldTransform(prim))
            got = np.array(base.Get(code)) @ matrix[:3, :3] + matrix[3, :3]
            np.testing.assert_allclose(got, world(fox, frame, turn, shift), rtol=1e-5, atol=1e-5)
            assert prim.GetAttribute("gs4d:time").Get(code) == pytest.approx(fox.frame_to_time(frame))
        opacity = prim.GetAttribute("primvars:displayOpacity")
        assert opacity.GetTimeSamples() == [offset + stretch * f for f in range(24)]
        exact = fox.at(fox.frame_to_time(9))[1]
        np.testing.assert_allclose(np.array(opacity.Get(offset + stretch * 9)), exact, atol=5.1e-4)


@pytest.mark.parametrize("name", ["shot.usda", "sublayer.usda", "centimetres.usda"])
def test_a_placed_asset_is_read_where_and_when_it_is(page, fox, name):
    (offset, stretch, turn, shift), = PLACES[name].values()  # fmt: skip
    if name == "centimetres.usda":  # the same place in the world: metres, Z up
        turn = Gf.Matrix4d(1)
    asset = read_usd(page / name)
    assert (asset.clip.frame_start, asset.clip.frame_end) == (offset, offset + stretch * 23) and asset.clip.fps == 24
    for frame in (0, 9.25, 23):
        time = asset.frame_to_time(offset + stretch * frame)
        np.testing.assert_allclose(world(asset, offset + stretch * frame, Gf.Matrix4d(1), (0, 0, 0)),
                                   world(fox, frame, turn, shift), atol=1e-4)  # fmt: skip
        np.testing.assert_allclose(asset.at(time)[1], fox.at(fox.frame_to_time(frame))[1], atol=1e-5)
    turned = np.array(turn)[:3, :3].T @ rotation_matrices(fox.rotation)
    np.testing.assert_allclose(rotation_matrices(asset.rotation), turned, atol=1e-5)
    np.testing.assert_allclose(asset.scale * asset.clip.scale, fox.scale * fox.clip.scale, rtol=1e-5)


@pytest.mark.parametrize(("offset", "scale", "rate"), [(0.5, 1.0, 24), (3, 1.3, 24), (0, 1.0, 30)])
def test_fractional_times_and_other_rates(page, fox, tmp_path, offset, scale, rate):
    """Clips have whole frames: the asset's own time is stretched to those around it."""
    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    stage.SetTimeCodesPerSecond(rate)
    UsdGeom.SetStageUpAxis(stage, "Z")
    UsdGeom.SetStageMetersPerUnit(stage, 1)
    prim = stage.DefinePrim("/a")
    prim.GetReferences().AddReference(str(page / "fox.usdc"), Sdf.LayerOffset(offset, scale))
    stage.Save()
    asset = read_usd(tmp_path / "a.usda")
    scale *= rate / 24
    for frame in (0, 9.25, 23):
        position, opacity = asset.at(asset.frame_to_time(offset + scale * frame))
        expected, exact = fox.at(fox.frame_to_time(frame))
        np.testing.assert_allclose(position, expected, atol=1e-5)
        np.testing.assert_allclose(opacity, exact, atol=1e-4)


def test_a_single_frame_between_two_frames(fox, tmp_path):
    write_usd(tmp_path / "fox.usdc", replace(fox, clip=replace(CLIP, frame_start=5, frame_end=5)))
    text = '#usda 1.0\n(upAxis = "Z"\nmetersPerUnit = 1)\ndef "a" (references = @./fox.usdc@ (offset = 0.4)) {}\n'
    (tmp_path / "a.usda").write_text(text)
    asset = read_usd(tmp_path / "a.usda")
    assert asset.clip.frames == range(5, 6)
    np.testing.assert_array_equal(asset.at(0)[0], fox.at(0)[0])


def test_crowds(page, fox, capsys):
    path = str(page / "crowd.usda")
    stage = Usd.Stage.Open(path)
    assert len(stage.GetPrototypes()) == 1
    c = UsdGeom.Imageable(stage.GetPrimAtPath("/crowd/c/splats"))
    assert c.ComputePurpose() == "render"
    assert UsdGeom.Imageable(stage.GetPrimAtPath("/crowd/a/splats")).ComputePurpose() == "default"
    boxes = UsdGeom.BBoxCache(0, ["default", "render"], useExtentsHint=True)
    asset = Usd.Stage.Open(str(page / "fox.usdc"))
    own = UsdGeom.BBoxCache(0, ["default"], useExtentsHint=False).ComputeWorldBound(asset.GetDefaultPrim())
    hint = UsdGeom.BBoxCache(0, ["default"], useExtentsHint=True).ComputeWorldBound(asset.GetDefaultPrim())
    own, hint = own.ComputeAlignedRange(), hint.ComputeAlignedRange()
    np.testing.assert_allclose([own.GetMin(), own.GetMax()], [hint.GetMin(), hint.GetMax()], atol=1e-5)
    closed = Usd.Stage.Open(path, Usd.Stage.LoadNone)
    assert not closed.GetPrimAtPath("/crowd/c/splats")
    box = boxes.ComputeWorldBound(closed.GetPrimAtPath("/crowd/c")).ComputeAlignedRange()
    assert (box.GetMin(), box.GetMax()) == (Gf.Vec3d(-2), Gf.Vec3d(2))
    closed.Load("/crowd/c")
    assert closed.GetPrimAtPath("/crowd/c/splats").HasAttribute("points")
    assert main(["export", path, str(page / "no.ply")]) == 2
    said = capsys.readouterr().err
    assert "holds 3 assets (/crowd/a/splats, /crowd/b/splats, /crowd/c/splats)" in said


def test_the_pages_python(page, fox, monkeypatch, capsys):
    monkeypatch.chdir(page)
    names: dict = {}
    for code in re.findall(r"```python\n(.*?)```", PAGE, re.S):
        exec(code, names)
    assert capsys.readouterr().out == "[]\n"
    positions, opacities = fox.at(fox.frame_to_time((1012.25 - 1001) / 2))
    np.testing.assert_allclose(names["positions"], positions, atol=1e-6)
    np.testing.assert_allclose(names["opacities"], opacities, atol=1e-6)


def test_a_shot_selects_the_original(page):
    stage = Usd.Stage.Open(str(page / "compare.usda"))
    assert stage.GetPrimAtPath("/shot/fox/original/object/mesh") and not stage.GetPrimAtPath("/shot/fox/splats")
    assert len(read_usd(page / "compare.usda")) == 50  # the asset is in there all the same


# ---------------------------------------------------------------- other readers


def child(code, *args, cwd=None) -> dict:
    return json.loads(run_child(code, *args, cwd=cwd))


OLD = """
import glob, importlib.util, json, sys
root = importlib.util.find_spec("bpy").submodule_search_locations[0]
sys.path[:0] = glob.glob(root + "/*/python/lib/python*/site-packages")
import numpy as np
import pxr
from pxr import Usd, UsdGeom
assert "site-packages/bpy/" in pxr.__file__
out = {"version": Usd.GetVersion()}
which = int(sys.argv[1])
for name in sys.argv[2:]:
    stage = Usd.Stage.Open(name)
    found = {}
    for p in stage.Traverse(Usd.TraverseInstanceProxies()):
        if p.GetName() == "splats":
            end = UsdGeom.Points(p).GetPointsAttr().Get(stage.GetEndTimeCode()) if p.IsA(UsdGeom.Points) else None
            found[str(p.GetPath())] = end and np.array(end)[which].tolist()
    out[name] = found
print("RESULT" + json.dumps(out))
"""


def without_fallback(text: str) -> str:
    return re.sub(r"    fallbackPrimTypes = \{.*?\n    \}\n", "", text, flags=re.S)


def test_an_older_reader_sees_points(page, fox):
    """pxr before 26.03 does not know the prim: fallbackPrimTypes counts, and only in the root layer."""
    pytest.importorskip("bpy")
    for name in list(SHOTS):
        text = without_fallback(SHOTS[name])
        (page / f"without_{name}").write_text(text)
        (page / f"points_{name}").write_text(text.replace("fox.usdc", "fox_points.usdc"))
    names = [*FILES, *PLACES]
    names += [f"{k}_{n}" for n in PLACES for k in ("without", "points")]
    position, opacity = fox.at(1)
    out = child(OLD, opacity.argmax(), *names, cwd=page)
    if tuple(out["version"]) >= (0, 26, 3):
        pytest.skip("this bpy knows the schema")
    for name in names:
        paths = PLACES.get(name.removeprefix("without_").removeprefix("points_"), {"/timesplat/splats": None})
        assert set(out[name]) == set(paths), name
        for path, point in out[name].items():
            if name.startswith("without") and path not in ("/crowd/a/splats", "/crowd/b/splats"):
                assert point is None, (name, path)
            else:
                np.testing.assert_allclose(point, position[opacity.argmax()], atol=1e-6)


READ = (
    OLD.split("import numpy")[0]
    + """
from timesplat.datagen.sequence import InputError
from timesplat.model.io.usd_check import check_usd
from timesplat.model.io.usd_read import read_usd
out = {}
for name in sys.argv[1:]:
    try:
        asset = read_usd(name)
        out[name] = [len(asset), asset.clip.frame_start, asset.clip.frame_end, check_usd(name)]
    except InputError as e:
        out[name] = str(e)
print("RESULT" + json.dumps(out))
"""
)


def test_the_older_library_reads_assets_too(page):
    pytest.importorskip("bpy")
    (page / "unknown.usda").write_text(
        re.sub(r"    fallbackPrimTypes = \{.*?\n    \}\n", "", SHOTS["shot.usda"], flags=re.S)
    )
    out = child(READ, "fox.usdz", "shot.usda", "centimetres.usda", "compare.usda", "unknown.usda", cwd=page)
    assert out["fox.usdz"] == out["compare.usda"] == out["centimetres.usda"] == [50, 0, 23, []]
    assert out["shot.usda"] == [50, 1001, 1047, []]
    assert "does not know the type of /shot/fox/splats; add fallbackPrimTypes" in out["unknown.usda"]


IMPORT = """
import json, sys
import bpy
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.wm.usd_import(filepath=sys.argv[1], set_frame_range=True)
scene = bpy.context.scene
out = {"range": [scene.frame_start, scene.frame_end], "frames": {}, "meshes": {}}
for frame in map(int, sys.argv[2:]):
    scene.frame_set(frame)
    graph = bpy.context.evaluated_depsgraph_get()
    out["frames"][frame], out["meshes"][frame] = [], []
    for instance in graph.object_instances:
        ob = instance.object
        if ob.type == "POINTCLOUD":
            out["frames"][frame].append([list(instance.matrix_world @ p.co) for p in ob.data.points])
        if ob.type == "MESH":
            out["meshes"][frame].append([list(instance.matrix_world @ v.co) for v in ob.data.vertices])
print("RESULT" + json.dumps(out))
"""


@pytest.mark.parametrize("name", PLACES)
def test_blender_imports_the_snippets(page, fox, name):
    pytest.importorskip("bpy")
    frames = (0, 9, 23)
    offset, stretch, *_ = next(iter(PLACES[name].values()))
    out = child(IMPORT, page / name, *(offset + stretch * f for f in frames))
    assert out["range"] == [offset, offset + stretch * 23]
    for frame in frames:
        clouds = np.array(out["frames"][str(offset + stretch * frame)])
        seen = fox.at(fox.frame_to_time(frame))[1] >= 0.05
        turn = Gf.Matrix4d(1) if name == "centimetres.usda" else None  # the importer turns and scales back
        for _, _, own, shift in PLACES[name].values():
            expected = world(fox, frame, turn or own, shift)
            assert min(np.abs(c - expected)[seen].max() for c in clouds) < 1e-4
        assert len(clouds) == len(PLACES[name])


def test_blender_imports_either_representation(page, fox):
    """The original where Blender's import of it by itself has it, at the same frames."""
    pytest.importorskip("bpy")
    alone, inside = (child(IMPORT, page / n, 0, 7, 23) for n in ("scene.usda", "compare.usda"))
    assert len(inside["meshes"]["7"]) == 1 and not inside["frames"]["7"]
    for frame in ("0", "7", "23"):
        np.testing.assert_allclose(inside["meshes"][frame], alone["meshes"][frame], atol=1e-6)
    out = child(IMPORT, page / "fox.usdz", 7)
    seen = fox.at(fox.frame_to_time(7))[1] >= 0.05
    expected = world(fox, 7, Gf.Matrix4d(1), (0, 0, 0))
    np.testing.assert_allclose(np.array(out["frames"]["7"][0])[seen], expected[seen], atol=1e-5)
    assert not out["meshes"]["7"]


@pytest.mark.parametrize("name", [*FILES, "shot.usda", "sublayer.usda"])
def test_a_reader_that_is_not_openusd(page, fox, name):
    lightusd = pytest.importorskip("lightusd")
    stage = lightusd.load(str(page / name))
    here = {"/timesplat/splats": (0, 1, Gf.Matrix4d(1), (0, 0, 0))}
    path, (offset, stretch, turn, shift) = next(iter(PLACES.get(name, here).items()))
    prim = stage.prim_at(path)
    base = "points" if name == "fox_points.usdc" else "positions"
    for frame in (0, 9, 11.5, 23):
        if name == "fox_frames.usdc" and frame % 1:
            continue
        code = offset + stretch * frame
        matrix = np.array(prim.world_transform(code))
        got = np.asarray(prim.attribute(base).get(time=code)) @ matrix[:3, :3] + matrix[3, :3]
        seen = fox.at(fox.frame_to_time(frame))[1] > 0.001
        np.testing.assert_allclose(got[seen], world(fox, frame, turn, shift)[seen], atol=1e-5)
    np.testing.assert_allclose(np.asarray(prim.attribute("primvars:gs4d:mu_t").get()), fox.t, atol=1e-3)
