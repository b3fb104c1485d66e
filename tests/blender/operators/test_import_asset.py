# SPDX-License-Identifier: GPL-3.0-or-later
"""File > Import: every kind of file through the operator, what stands in the scene then, and what is refused."""

import gzip
import struct
import sys

import numpy as np
import pytest

from timesplat.model.io import slices
from timesplat.model.io.asset import ARRAYS, VISIBLE
from timesplat.model.io.ply import columns_3dgs, ply_bytes, read_ply, write_ply

from ..helpers import make

IMPORT = """
import atexit
part("addon").register()
atexit.register(part("addon").unregister)  # bpy 4.2 crashes at its end otherwise
display = part("addon.asset.display")
def load(**options):
    try:
        done = bpy.ops.timesplat.import_asset(**{"look": "Points"} | options)
    except RuntimeError as e:
        return {"error": str(e).strip().removeprefix("Error: ")}
    ob, scene = bpy.context.object, bpy.context.scene
    return dict(done=list(done), name=ob.name, world=[list(r) for r in ob.matrix_world],
                range=[scene.frame_start, scene.frame_end], fps=scene.render.fps / scene.render.fps_base)
def seen(frame):
    bpy.context.scene.frame_set(int(frame), subframe=frame % 1)
    ob = bpy.context.object
    for i in bpy.context.evaluated_depsgraph_get().object_instances:  # where a mesh stands in, it is an instance of it
        if i.object.type == "POINTCLOUD" and (i.object.original == ob or i.parent and i.parent.original == ob):
            return [list(i.matrix_world @ p.co) for p in i.object.data.points]
"""


def test_our_ply_lies_where_it_was_made(blender, tmp_path):
    asset = make(77)
    write_ply(tmp_path / "walk.v2.ply", asset)
    code = IMPORT + "tell(**load(filepath=sys.argv[1], use_clip=True), seen=seen(21.5))"
    told = blender(code, tmp_path / "walk.v2.ply")
    assert told["done"] == ["FINISHED"] and told["name"] == "walk.v2" and told["range"] == [10, 33]
    assert abs(told["fps"] - 23.976) < 1e-4
    np.testing.assert_allclose(told["world"], [[2.5, 0, 0, 1], [0, 2.5, 0, -2], [0, 0, 2.5, 3], [0, 0, 0, 1]])
    xyz, opacity = asset.at(asset.frame_to_time(21.5))
    np.testing.assert_allclose(told["seen"], xyz[opacity >= VISIBLE] * 2.5 + [1, -2, 3], atol=2e-5)


def test_other_programs_files_stand_upright(blender, tmp_path):
    """A slice has -Y up and lies over the asset again; .spz has Y up."""
    asset = make(60)
    for suffix in ("ply", "splat"):
        slices.write_slice(tmp_path / f"a.{suffix}", asset, 12)
    head = struct.pack("<4sIIBBBB", b"NGSP", 3, 1, 0, 4, 0, 0)
    point = b"".join((16 * v).to_bytes(3, "little", signed=True) for v in (1, 2, 3))
    (tmp_path / "a.spz").write_bytes(gzip.compress(head + point + bytes([255, 1, 2, 3, 90, 90, 90, 0, 0, 0, 192])))
    code = IMPORT + "tell(**{a[-3:]: [load(filepath=a), seen(5)] for a in sys.argv[1:4]},\n"
    code += "     z=[load(filepath=sys.argv[3], up='Z'), seen(5)])"
    told = blender(code, *(tmp_path / f"a.{s}" for s in ("ply", "splat", "spz")))
    xyz, opacity = asset.at(asset.frame_to_time(12))
    world = xyz[opacity >= VISIBLE] * 2.5 + [1, -2, 3]
    np.testing.assert_allclose(told["ply"][1], world, atol=2e-5)
    got = np.array(told["lat"][1])
    assert len(got) == len(world)
    assert np.abs(got[:, None] - world[None]).max(2).min(1).max() < 2e-5  # in another order
    np.testing.assert_allclose(told["spz"][1], [[1, -3, 2]], atol=1e-6)  # Y is up, and +Z comes to the front, -Y
    np.testing.assert_allclose(told["z"][1], [[1, 2, 3]], atol=1e-6)


def test_what_is_far_away_is_turned_about_the_origin_of_the_world(blender, tmp_path):
    asset, at = make(60), np.array([3000.0, 4000.0, 5000.0])  # of the slice, -Y up
    part = slices.slice_at(asset, 12)
    part.xyz[:] = part.xyz / 100 + at
    part.xyz[7] = np.nan
    columns = columns_3dgs(part)
    (tmp_path / "a.ply").write_bytes(ply_bytes(columns, []))
    told = blender(IMPORT + "tell(**load(filepath=sys.argv[1]), seen=seen(5))", tmp_path / "a.ply")
    assert told["done"] == ["FINISHED"]
    world = np.delete(part.xyz, 7, 0)[:, [0, 2, 1]] * [1, 1, -1]
    np.testing.assert_allclose(told["seen"], world, atol=2e-3)


def test_several_files_or_a_folder_are_a_sequence(blender, tmp_path):
    folder = tmp_path / "run"
    parts = [make(n, seed=n) for n in (5, 9, 7)]
    folder.mkdir()
    names = ["f8.ply", "f9.ply", "f10.ply"]
    for part, name in zip(parts, names, strict=True):
        slices.write_slice(folder / name, part, 12)
    code = (
        IMPORT
        + """
names = ["f10.ply", "f8.ply", "f9.ply"]
result = {}
for key, options in (
    ("files", dict(directory=sys.argv[1], files=[{"name": n} for n in names])),
    ("folder", dict(filepath=sys.argv[1])),
):
    result[key] = [load(**options, frame_start=4, fps=12.5, use_clip=True), *(seen(f) for f in (3, 4, 5, 6, 7))]
tell(**result)
"""
    )
    told = blender(code, folder)
    for key in ("files", "folder"):
        loaded, *shown = told[key]
        assert loaded["name"].startswith("run") and loaded["range"] == [4, 6] and abs(loaded["fps"] - 12.5) < 1e-6
        for got, k in zip(shown, (0, 0, 1, 2, 2), strict=True):
            xyz, opacity = parts[k].at(parts[k].frame_to_time(12))
            np.testing.assert_allclose(got, xyz[opacity >= VISIBLE] * 2.5 + [1, -2, 3], atol=2e-5)


def test_usd_through_the_worker_and_directly(blender, tmp_path):
    """Where there is no worker Blender's own pxr reads it; the arrays are the same."""
    usd = pytest.importorskip("timesplat.model.io.usd_write")
    pytest.importorskip("pxr")
    asset = make(50)
    usd.write_usd(tmp_path / "a.usdz", asset)
    (tmp_path / "bad.usda").write_text("#usda 1.0\n( oh")
    code = (
        IMPORT
        + """
from pathlib import Path
importer, find = part("addon.operators.import_asset"), importlib.util.find_spec
result, named = {}, os.environ["TIMESPLAT_PYTHON"]
def hidden(name):
    return None if name in ("pxr", "torch") else find(name)
for key in ["worker", "direct"] if find("pxr") else ["worker"]:
    os.environ["TIMESPLAT_PYTHON"] = named if key == "worker" else "/nowhere/python"
    result[key] = load(filepath=sys.argv[1])
    got = importer.read_assets([Path(sys.argv[1])], fps=24, frame_start=1)
    part("model.io.ply").write_ply(sys.argv[3] + key + ".ply", got.asset)
    result[key + "_bad"] = load(filepath=sys.argv[2])
    result[key + "_none"] = load(filepath=sys.argv[2] + "c.usdc")
os.environ["TIMESPLAT_PYTHON"] = named
worker = importer.child_process.ask_worker
def crash(python, request):
    raise part("datagen.sequence").InputError("The process was ended by signal 11: it said nothing")
importer.child_process.ask_worker = crash
result["crash"] = load(filepath=sys.argv[1])
importer.child_process.ask_worker = worker
os.environ["TIMESPLAT_PYTHON"] = "/nowhere/python"
importlib.util.find_spec = hidden
result["python"] = load(filepath=sys.argv[1])
os.environ["TIMESPLAT_PYTHON"] = named
def full(*a, **k):
    raise OSError(28, "No space left on device", "/full/x")
importer.tempfile.TemporaryDirectory, kept = full, importer.tempfile.TemporaryDirectory
result["full"] = load(filepath=sys.argv[1])
importer.tempfile.TemporaryDirectory = kept
result["two"] = load(directory=".", files=[{"name": "a.usdz"}, {"name": "b.usdz"}])
importlib.util.find_spec = find
tell(**result, left=os.listdir(os.environ["TMPDIR"]))
"""
    )
    env = {"TIMESPLAT_PYTHON": sys.executable}
    told = blender(code, tmp_path / "a.usdz", tmp_path / "bad.usda", f"{tmp_path}/", env=env)
    for key in [k for k in ("worker", "direct") if k in told]:
        np.testing.assert_allclose(np.array(told[key]["world"])[:3, 3], [1, -2, 3])
        got = read_ply(tmp_path / f"{key}.ply")
        for name in ARRAYS:
            np.testing.assert_allclose(getattr(got, name), getattr(asset, name), rtol=2e-6, atol=2e-6, err_msg=name)
        assert "damaged or not a USD file" in told[f"{key}_bad"]["error"]
        assert "no such file" in told[f"{key}_none"]["error"]
    assert "no such file" in told["python"]["error"] and "one by one" in told["two"]["error"]
    assert "a.usdz: the library gave up on it; it is damaged" in told["crash"]["error"]
    assert told["full"]["error"] == "/full/x: it cannot be written (No space left on device); make room."
    assert not [n for n in told["left"] if n.startswith("timesplat-")]


def test_a_wrong_file_gets_a_sentence_and_leaves_nothing(blender, tmp_path):
    (tmp_path / "photo.splat").write_bytes(b"\xff\xd8\xff\xe0" + bytes(400))
    (tmp_path / "mesh.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 0\nelement face 0\nend_header\n")
    (tmp_path / "cut.spz").write_bytes(b"\x1f\x8b\x08")
    (tmp_path / "empty").mkdir()
    write_ply(tmp_path / "four.ply", make(3))
    code = (
        IMPORT
        + """
folder = sys.argv[1] + os.sep
count = len(bpy.data.objects), len(bpy.data.meshes)
names = "photo.splat", "mesh.ply", "cut.spz", "empty", "none.ply", "a.obj"
result = {n: load(filepath=folder + n)["error"] for n in names}
result["nothing"] = load()["error"]
result["mixed"] = load(directory=folder, files=[{"name": "four.ply"}, {"name": "four.ply"}])["error"]
tell(errors=result, same=count == (len(bpy.data.objects), len(bpy.data.meshes)))
"""
    )
    told = blender(code, tmp_path)
    assert told["same"]
    for key, words in {
        "photo.splat": "it is a JPEG picture, not a Gaussian splat .splat",
        "mesh.ply": "it is a polygon mesh",
        "cut.spz": "truncated",
        "empty": "there is no .ply, .splat, .spz, .sog in this folder",
        "none.ply": "no such file",
        "a.obj": "must end in",
        "nothing": "No file was chosen",
        "mixed": "import it alone",
    }.items():
        said = told["errors"][key]
        assert words in said and "Traceback" not in said and "\n" not in said, said


def test_menu_and_drop(blender):
    """The entries are there, the handler takes all suffixes, and both go with the add-on."""
    code = """
    part("addon").register()
    handler = bpy.types.TIMESPLAT_FH_splats
    drawn = lambda: [f.__module__ for f in bpy.types.TOPBAR_MT_file_import.draw._draw_funcs]
    there = drawn()
    operator = bpy.ops.timesplat.import_asset.get_rna_type().properties.keys()
    suffixes, target = handler.bl_file_extensions, handler.bl_import_operator
    part("addon").unregister()
    tell(there=there, gone=drawn(), suffixes=suffixes, target=target, operator=list(operator),
         handler=hasattr(bpy.types, "TIMESPLAT_FH_splats"))
    """
    told = blender(code)
    module = "timesplat.addon.operators.import_asset"
    assert module in told["there"] and module not in told["gone"]
    assert (
        told["suffixes"] == ".ply;.splat;.spz;.sog;.4dgs;.html;.usd;.usdc;.usda;.usdz"
        and told["target"] == "timesplat.import_asset"
    )
    assert {"filepath", "directory", "files"} <= set(told["operator"]) and not told["handler"]
