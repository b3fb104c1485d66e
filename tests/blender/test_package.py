# SPDX-License-Identifier: GPL-3.0-or-later
"""The extension's .zip: what it holds, and that it comes and goes without a trace."""

import zipfile
from fnmatch import fnmatch

import numpy as np

from timesplat.model.asset import write_ply

from .helpers import make

ALLOWED = [
    *("__init__.py", "LICENSE", "README.md", "blender_manifest.toml", "cli.py", "demo.py"),
    *("addon/*.py", "datagen/*.py", "model/*.py", "model/baselines/*.py", "model/rasterize/*.py"),
    *("model/checkpoints/*.safetensors", "model/checkpoints/*.md"),
]
NEEDED = [
    "__init__.py",
    "LICENSE",
    "blender_manifest.toml",
    "addon/display.py",
    "datagen/capture.py",
    "model/worker.py",
]


def test_the_zip_holds_what_it_should_and_no_more(extension):
    names = zipfile.ZipFile(extension).namelist()
    strange = [n for n in names if not any(fnmatch(n, p) and n.count("/") == p.count("/") for p in ALLOWED)]
    assert not strange
    assert {*NEEDED, "model/worker.py"} <= set(names)
    assert extension.stat().st_size < 40e6


USE = """
done = bpy.ops.timesplat.import_asset(filepath=sys.argv[1], use_clip=True, look="Splats")
ob, scene = bpy.context.object, bpy.context.scene
result = dict(done=list(done), kind=ob.type, count=len(ob.data.points), scale=list(ob.scale), at=list(ob.location),
    range=[scene.frame_start, scene.frame_end], fps=scene.render.fps / scene.render.fps_base,
    label=scene.timesplat.bl_rna.name, modules=[m for m in sys.modules if m.split(".")[0] == "timesplat"])
try:
    bpy.ops.timesplat.import_asset(filepath=sys.argv[2])
except RuntimeError as e:
    result["refused"] = str(e)
bpy.ops.preferences.addon_disable(module=name)
ours = [x for x in dir(bpy.types) if x.startswith("TIMESPLAT")]
bpy.ops.preferences.addon_enable(module=name)
again = [x for x in dir(bpy.types) if x.startswith("TIMESPLAT")]
bpy.ops.preferences.addon_disable(module=name)
left = [f.__module__ for f in bpy.types.TOPBAR_MT_file_import.draw._draw_funcs]
tell(**result, ours=ours, again=again, left=left, scene=hasattr(bpy.types.Scene, "timesplat"),
     torch="torch" in sys.modules, version=bpy.app.version)
"""


def test_installed_it_imports_and_goes_away_again(installed, tmp_path):
    write_ply(tmp_path / "a.ply", make(77))
    (tmp_path / "bad.ply").write_bytes((tmp_path / "a.ply").read_bytes()[:-5])
    told = installed(USE, tmp_path / "a.ply", tmp_path / "bad.ply")
    assert told["done"] == ["FINISHED"] and told["kind"] == "POINTCLOUD" and told["count"] == 77
    np.testing.assert_allclose(told["scale"] + told["at"], [2.5] * 3 + [1, -2, 3])
    assert told["range"] == [10, 33] and abs(told["fps"] - 23.976) < 1e-4
    assert "truncated" in told["refused"] and "bad.ply" in told["refused"] and "Traceback" not in told["refused"]
    assert told["ours"] == [] and len(told["again"]) >= 5 and not told["scene"]
    assert not any("timesplat" in m for m in told["left"])
    assert not told["torch"] and told["modules"] == []
