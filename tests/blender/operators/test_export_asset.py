# SPDX-License-Identifier: GPL-3.0-or-later
"""File > Export: what is in the files is what the object shows, where it stands; round trips; and what is refused."""

import os
import sys

import numpy as np
import pytest

from timesplat.model.io import files as formats
from timesplat.model.io.asset import ARRAYS, VISIBLE, rotation_matrices
from timesplat.model.io.ply import read_ply

from ..helpers import CLIP, EXPORT, same


def test_4d_ply_comes_back_the_same(blender, folder):
    told = blender(EXPORT + "tell(done=save('out.ply'), again=save('out.ply'))", folder)
    assert told["done"] == told["again"] == ["FINISHED"]
    asset, got = read_ply(folder / "in.ply"), read_ply(folder / "out.ply")
    assert got.clip == asset.clip == CLIP
    same(got, asset)
    assert sorted(os.listdir(folder)) == ["in.ply", "out.ply"]


def test_a_page_holds_what_the_ply_does(blender, folder):
    told = blender(
        EXPORT + "tell(done=save('out.html'), other=save('a.usdc', format='PAGE'), ply=save('out.ply'))", folder
    )
    assert told["done"] == told["other"] == ["FINISHED"]
    assert sorted(os.listdir(folder)) == ["a.html", "in.ply", "out.html", "out.ply"]
    same(formats.read_asset(folder / "out.html").asset, read_ply(folder / "out.ply"), 0, 0)


def test_the_current_frame_in_other_programs_formats(blender, folder):
    code = "scene.frame_set(20)\ntell(done=[save(f'a.{x}') for x in ('splat', 'spz', 'glb')])"
    assert blender(EXPORT + code, folder)["done"] == [["FINISHED"]] * 3
    asset = read_ply(folder / "in.ply")
    xyz, opacity = asset.at(asset.frame_to_time(20))
    world = xyz[opacity >= VISIBLE] * CLIP.scale + np.array(CLIP.translation)
    for suffix in ("splat", "spz"):
        got = formats.upright(formats.read_asset(folder / f"a.{suffix}")).xyz
        assert len(got) == len(world)
        assert np.abs(got[:, None] - world[None]).max(2).min(1).max() < 2e-5  # in another order
    assert (folder / "a.glb").read_bytes()[:4] == b"glTF"


def test_what_blender_lacks_libraries_for_is_written_and_read_by_the_worker(blender, folder):
    """.sog and .4dgs come back where they stood, a folder of .sog as a sequence; without a worker it is a sentence."""
    pytest.importorskip("fourdgs")
    code = """
scene.frame_start, scene.frame_end = 19, 21
scene.frame_set(20)
done = [save("a.sog"), save("a.4dgs"), save("frames", format="SLICES", kind="SOG")]
def world():
    asset, ob = holding.asset_of(bpy.context.object), bpy.context.object
    xyz, alpha = asset.at(asset.frame_to_time(20))
    return (np.c_[xyz, np.ones(len(xyz))] @ np.array(ob.matrix_world).T)[alpha >= 0.05, :3].tolist()
places = {}
for name in ("a.sog", "a.4dgs", "frames"):
    done.append(list(bpy.ops.timesplat.import_asset(filepath=folder + name, frame_start=19)))
    bpy.context.view_layer.update()
    places[name] = world()
bpy.context.view_layer.objects.active = ob
os.environ["TIMESPLAT_PYTHON"] = "/nowhere/python"
told = [save("b.sog"), save("b.4dgs")]
for name in ("a.sog", "a.4dgs"):
    try:
        bpy.ops.timesplat.import_asset(filepath=folder + name)
    except RuntimeError as e:
        told.append(str(e))
tell(done=done, places=places, told=told)
"""
    told = blender(EXPORT + code, folder, env={"TIMESPLAT_PYTHON": sys.executable})
    assert told["done"] == [["FINISHED"]] * 6
    asset = read_ply(folder / "in.ply")
    xyz, opacity = asset.at(asset.frame_to_time(20))
    world = xyz * CLIP.scale + np.array(CLIP.translation)
    for name, got in told["places"].items():
        found = np.array(got)
        away = np.abs(world[opacity >= VISIBLE][:, None] - found[None]).max(2).min(1)
        assert np.percentile(away, 97) < 5e-3, name
        assert abs(len(found) - (opacity >= VISIBLE).sum()) < 5
    for said in told["told"]:
        assert "is read and written by Timesplat's runtime. /nowhere/python: no such file" in said
    assert sorted(os.listdir(folder)) == ["a.4dgs", "a.sog", "frames", "in.ply"]
    assert sorted(os.listdir(folder / "frames")) == [f"frames_00{k}.sog" for k in (19, 20, 21)]


def test_deleted_gaussians_and_sliders_reach_the_file(blender, folder):
    code = """
edit.keep_gaussians(ob, np.arange(120) % 3 > 0)
done = [save("kept.ply")]
sliders.set_input(sliders.asset_modifier(ob), "Time Scale", 2.0)
sliders.set_input(sliders.asset_modifier(ob), "Lifetime Scale", 0.5)
done += [save("applied.ply"), save("raw.ply", apply_sliders=False)]
bpy.ops.timesplat.import_asset(filepath=folder + "kept.ply")
tell(done=done, again=len(holding.asset_of(bpy.context.object)))
"""
    told = blender(EXPORT + code, folder)
    assert told["done"] == [["FINISHED"]] * 3 and told["again"] == 80
    asset = read_ply(folder / "in.ply")
    kept = np.arange(120) % 3 > 0
    for name in ("kept", "raw"):
        got = read_ply(folder / f"{name}.ply")
        for key in ARRAYS:
            np.testing.assert_allclose(getattr(got, key), getattr(asset, key)[kept], rtol=4e-6, atol=4e-6)
    got = read_ply(folder / "applied.ply")
    assert got.clip.frame_end - got.clip.frame_start < 13 and len(got) <= 80
    quick = asset.at(asset.frame_to_time(20))[0][kept]
    xyz = got.at(got.frame_to_time(15))[0]  # twice as fast
    assert np.abs(xyz[:, None] - quick[None]).max(2).min(1).max() < 1e-4


def test_the_object_is_exported_where_it_stands(blender, folder):
    """Moved, turned, under a parent, sheared: in the world the file's Gaussians are the object's."""
    code = """
from mathutils import Euler, Matrix
parent = bpy.data.objects.new("Parent", None)
scene.collection.objects.link(parent)
told = {}
def pose(name, matrix, above=None):
    parent.matrix_world = above or Matrix()
    ob.parent = parent if above else None
    ob.matrix_world = matrix
    told[name] = [save(name + ".ply"), save(name + "_slice.ply", format="SLICE"), [list(r) for r in ob.matrix_world]]
scene.frame_set(20)
pose("moved", Matrix.Translation((7, 8, 9)) @ Matrix.Scale(0.5, 4))
pose("turned", Matrix.LocRotScale((1, 2, 3), Euler((0.3, 1, -2)), (2, 2, 2)))
pose("sheared", Matrix.LocRotScale(None, Euler((0, 1, 0)), None), Matrix.LocRotScale((1, 0, 0), None, (3, 1, -0.5)))
ob.parent = None
ob.matrix_world = Matrix.Diagonal((1, 1, 0, 1))
tell(flat=save("flat.ply"), **told)
"""
    told = blender(EXPORT + code, folder)
    asset = read_ply(folder / "in.ply")
    xyz, opacity = asset.at(asset.frame_to_time(20))
    for name in ("moved", "turned", "sheared"):
        done, sliced, matrix = told[name]
        assert done == sliced == ["FINISHED"]
        M = np.array(matrix)
        got = read_ply(folder / f"{name}.ply")
        world = xyz @ M[:3, :3].T + M[:3, 3]
        now = got.at(got.frame_to_time(20))
        np.testing.assert_allclose(now[0] * got.clip.scale + got.clip.translation, world, atol=2e-5)
        np.testing.assert_allclose(now[1], opacity, atol=1e-5)
        R = rotation_matrices(asset.rotation) * asset.soft_scale()[:, None]
        R = M[:3, :3] @ R
        want = R @ R.transpose(0, 2, 1)
        S = rotation_matrices(got.rotation) * got.soft_scale()[:, None] * got.clip.scale
        np.testing.assert_allclose(S @ S.transpose(0, 2, 1), want, rtol=2e-3, atol=1e-5 * np.abs(want).max())
        part = formats.read_asset(folder / f"{name}_slice.ply").asset
        seen = world[now[1] >= VISIBLE]
        np.testing.assert_allclose(part.xyz, np.stack([seen[:, 0], -seen[:, 2], seen[:, 1]], 1), atol=2e-5)
    assert "scaled to nothing" in told["flat"] and "flat.ply" not in os.listdir(folder)


def test_usd_is_written_checked_and_read_again(blender, folder):
    pytest.importorskip("pxr")
    from timesplat.model.io import usd_check, usd_read

    code = """
import importlib.util
result, named = {}, os.environ["TIMESPLAT_PYTHON"]
for key in ["worker", "direct"] if importlib.util.find_spec("pxr") else ["worker"]:
    os.environ["TIMESPLAT_PYTHON"] = named if key == "worker" else "/nowhere/python"
    for n, options in {"a.usdc": {}, "b.usdz": {"half": True}, "c.usda": {"mode": "points"}, "d": {"format": "USDC",
                       "mode": "frames"}}.items():
        result[key + "_" + n] = [save(key + "_" + n, **options), bpy.data.texts["Timesplat USD report"].as_string()]
tell(**result, left=os.listdir(os.environ["TMPDIR"]))
"""
    told = blender(EXPORT + code, folder, env={"TIMESPLAT_PYTHON": sys.executable})
    assert not [n for n in told.pop("left") if n.startswith("timesplat-")]
    asset = read_ply(folder / "in.ply")
    for name, (done, report) in told.items():
        path = folder / (name if "." in name else f"{name}.usdc")
        assert done == ["FINISHED"] and "120 Gaussians" in report, done
        assert usd_check.check_usd(path) == [] and report.splitlines()[2] == "valid USD"
        half = name.endswith("z")
        got = usd_read.read_usd(path)
        np.testing.assert_allclose(got.clip.translation, asset.clip.translation)
        same(got, asset, atol=1e-3 if half else 4e-6, rtol=2e-3 if half else 4e-6)


def test_complaints_are_told_and_kept_as_a_text(blender, folder):
    code = """
exporter = part("addon.operators.export_asset")
exporter.write_usd = lambda path, *a, **k: path.write_text("x") and ["it is blue", "it is round"]
tell(done=save("a.usda"), text=bpy.data.texts["Timesplat USD report"].as_string())
"""
    told = blender(EXPORT + code, folder)
    assert told["done"] == ["FINISHED"]
    assert "2 complaints" in told["text"] and told["text"].endswith("it is blue\nit is round\n")


def test_with_original(blender, folder):
    """The variant set has both; the scene is as it was."""
    Usd = pytest.importorskip("pxr.Usd")
    code = """
def cube(name, x):
    bpy.ops.mesh.primitive_cube_add(size=1, location=(x, 0, 0))
    bpy.context.object.name = name
    return bpy.context.object
cube("Other", 9)
original = cube("Walker", 1)
for frame, x in ((10, 1.0), (33, 3.0)):
    original.location.x = x
    original.keyframe_insert("location", frame=frame)
other = bpy.data.objects["Other"]
original.hide_set(True)
bpy.ops.object.select_all(action="DESELECT")
other.select_set(True)
bpy.context.view_layer.objects.active = ob
scene.frame_start, scene.frame_end = 1, 5
scene.frame_set(21, subframe=0.25)
told = {"unknown": save("u.usdz", with_original=True)}
ob["timesplat_source"] = ["Walker", "Gone"]
told["usdz"], told["usdc"] = save("a.usdz", with_original=True), save("b.usdc", with_original=True)
exporter = part("addon.operators.export_asset")
def fails(*a, **k):
    raise part("datagen.sequence").InputError("a.ply: the disk is full; make room.")
exporter.write_usd = fails
told["full"] = save("c.usdc", with_original=True)
tell(**told, selected=[o.name for o in bpy.context.selected_objects], active=bpy.context.object.name,
     hidden=[original.hide_get(), original.hide_viewport], range=[scene.frame_start, scene.frame_end],
     frame=scene.frame_current_final, usd=bpy.app.build_options.usd)
"""
    told = blender(EXPORT + code, folder, env={"TIMESPLAT_PYTHON": sys.executable})
    assert told["selected"] == ["Other"] and told["active"] == "Walk. 1" and told["hidden"] == [True, False]
    assert told["range"] == [1, 5] and told["frame"] == 21.25
    if not told["usd"]:
        assert "built without USD" in told["usdz"] and sorted(os.listdir(folder)) == ["in.ply"]
        return
    assert "was made from is not in this view layer" in told["unknown"] and "disk is full" in told["full"]
    assert told["usdz"] == told["usdc"] == ["FINISHED"]
    assert sorted(os.listdir(folder)) == ["a.usdz", "b.usdc", "b_original.usdc", "in.ply"]
    from pxr import UsdGeom

    for name in ("a.usdz", "b.usdc"):
        stage = Usd.Stage.Open(str(folder / name))
        (variants,) = [p.GetVariantSets() for p in stage.Traverse() if p.HasVariantSets()][:1]
        (kind,) = variants.GetNames()
        assert set(variants.GetVariantSet(kind).GetVariantNames()) == {"original", "reconstruction"}
        variants.GetVariantSet(kind).SetVariantSelection("original")
        meshes = [p for p in stage.Traverse() if p.IsA(UsdGeom.Mesh)]
        assert len(meshes) == 1
        for frame, x in ((10, 1), (33, 3)):
            place = UsdGeom.Xformable(meshes[0]).ComputeLocalToWorldTransform(frame).ExtractTranslation()
            np.testing.assert_allclose(place, [x, 0, 0], atol=1e-4)


def test_what_cannot_be_exported_gets_a_sentence(blender, folder):
    code = """
told = {"place": save("in.ply/x.ply"), "folder": save("in.ply/x", format="SLICES")}
bpy.ops.mesh.primitive_cube_add()
told["cube"] = bpy.ops.timesplat.export_asset.poll()
told["why"] = save("c.ply")
bpy.context.view_layer.objects.active = ob
told["can"] = bpy.ops.timesplat.export_asset.poll()
tell(**told)
"""
    told = blender(EXPORT + code, folder)
    assert told["cube"] is False and told["can"] is True and "Select a Timesplat asset" in told["why"]
    for key in ("place", "folder"):
        assert "in.ply" in told[key] and "Traceback" not in told[key] and "\n" not in told[key], told[key]
    assert sorted(os.listdir(folder)) == ["in.ply"]


def test_names_follow_the_format(blender, tmp_path):
    code = """
part("addon").register()
exporter = part("addon.operators.export_asset")
menu = [d.__module__ for d in bpy.types.TOPBAR_MT_file_export.draw._draw_funcs]
part("addon").unregister()
f, k = exporter.with_suffix, exporter.format_of
tell(names=[f("/x/a", "USDZ"), f("/x/a.ply", "USDC"), f("/x/a.v2", "PLY"), f("/x/a.v2.USDA", "SLICES")],
     typed=[k("a.usdz", "PLY"), k("a", "USDA"), k("a.v2", "USDA"), k("a.PLY", "SLICE"), k("a.ply", "SLICES")],
     kinds=sorted(exporter.SUFFIXES) == sorted(i[0] for i in exporter.FORMAT_ITEMS), menu=menu,
     gone=[d.__module__ for d in bpy.types.TOPBAR_MT_file_export.draw._draw_funcs])
"""
    told = blender(code)
    assert told["names"] == ["/x/a.usdz", "/x/a.usdc", "/x/a.v2.ply", "/x/a.v2"] and told["kinds"]
    assert told["typed"] == ["USDZ", "USDA", "USDA", "SLICE", "PLY"]
    module = "timesplat.addon.operators.export_asset"
    assert module in told["menu"] and module not in told["gone"]


def test_blender_and_the_command_line_read_and_write_the_same_formats(blender):
    """One dispatch: what either knows the other knows, and the menus name it all."""
    code = """
importer, exporter = part("addon.operators.import_asset"), part("addon.operators.export_asset")
said = []
class Layout:
    def operator(self, name, text): said.append(text)
menu = type("Menu", (), {"layout": Layout()})()
importer._menu(menu, None), exporter._menu(menu, None)
part("addon").register()
globs = [bpy.ops.timesplat.import_asset.get_rna_type().properties["filter_glob"].default,
         bpy.ops.timesplat.export_asset.get_rna_type().properties["filter_glob"].default]
tell(writes=exporter.SUFFIXES, kinds=[i[1] for i in exporter.KIND_ITEMS], said=said, globs=globs,
     drops=importer.TIMESPLAT_FH_splats.bl_file_extensions)
part("addon").unregister()
"""
    told = blender(code)
    whole, slices = set(formats.WRITABLE), set(formats.SLICE_FORMATS)
    assert set(told["writes"].values()) - {""} == (whole | slices) - {".usd"}, "one of .usdc, .usda and .usdz is chosen"
    assert set(told["kinds"]) == slices
    assert set(told["drops"].split(";")) == set(formats.READABLE) == {g[1:] for g in told["globs"][0].split(";")}
    assert {g[1:] for g in told["globs"][1].split(";")} == whole | slices
    reads, writes = told["said"]
    for suffix in formats.READABLE:
        assert (".usd*" if suffix.startswith(".usd") else suffix) in reads
    for suffix in whole | slices:
        assert (".usd*" if suffix.startswith(".usd") else suffix) in writes
    assert whole <= set(formats.READABLE) and slices - set(formats.READABLE) == {".glb"}, "what is written is read"


def test_installed_as_an_extension(installed, folder):
    """From the .zip, by its operators alone: in, out as USD, in again."""
    code = """
folder = sys.argv[1] + os.sep
ops, steps = bpy.ops.timesplat, []
for kind, name in ("import", "in.ply"), ("export", "out.usdz"), ("import", "out.usdz"), ("export", "out.ply"):
    steps.append(getattr(ops, kind + "_asset")(filepath=folder + name))
tell(steps=[list(s) for s in steps], modules=[m for m in sys.modules if m.split(".")[0] in ("timesplat", "torch")])
"""
    pytest.importorskip("pxr")
    told = installed(code, folder)
    assert told["steps"] == [["FINISHED"]] * 4 and told["modules"] == []
    same(read_ply(folder / "out.ply"), read_ply(folder / "in.ply"))
