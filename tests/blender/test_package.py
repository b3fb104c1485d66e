# SPDX-License-Identifier: GPL-3.0-or-later
"""The extension's .zip: what it holds, and that it comes, works in its own namespace and goes without a trace."""

import subprocess
import zipfile
from pathlib import Path

import numpy as np
import pytest

from timesplat.model.io.ply import read_ply, write_ply

from .helpers import REAL, ROOT, TARGET, make

ALLOWED = [
    *("__init__.py", "LICENSE", "README.md", "blender_manifest.toml"),
    *("addon/*.py", "addon/*/*.py", "datagen/*.py", "datagen/*/*.py", "model/*.py"),
    *("model/deformation/*.py", "model/fitting/*.py", "model/geometry/*.py", "model/io/*.py"),
    *("model/rasterize/*.py", "model/rasterize/*/*.py"),
    "model/io/player/*",
    *("model/checkpoints/*.safetensors", "model/checkpoints/*.md"),
]
NEEDED = {
    "__init__.py",
    "LICENSE",
    "blender_manifest.toml",
    "addon/asset/display.py",
    "datagen/capture.py",
    "model/worker.py",
}


def test_the_zip_holds_what_it_should_and_no_more(extension):
    names = zipfile.ZipFile(extension).namelist()
    expected = [f.relative_to(ROOT).as_posix() for p in ALLOWED for f in ROOT.glob(p)]
    assert sorted(names) == sorted(expected) and set(names) >= NEEDED
    assert extension.stat().st_size < 40e6


@pytest.fixture(scope="module")
def tool():
    """The command `extension` of this Blender; the bpy wheel has it as a script."""
    if REAL:
        return [TARGET, "--command", "extension"]
    where = [TARGET, "-c", "import importlib.util as u; print(u.find_spec('bpy').origin)"]
    wheel = Path(subprocess.check_output(where, text=True).strip()).parent
    return [TARGET, str(next(wheel.glob("*/scripts/addons_core/bl_pkg/cli/blender_ext.py")))]


def test_this_blender_validates_and_builds_it_without_a_complaint(tool, extension, tmp_path):
    def run(*args):
        done = subprocess.run([*tool, *map(str, args)], capture_output=True, text=True)
        said = (done.stdout + done.stderr).lower()
        assert done.returncode == 0 and not any(x in said for x in ("warn", "error", "fatal", "missing")), said

    run("validate", ROOT)
    run("build", "--source-dir", ROOT, "--output-dir", tmp_path)
    (built,) = tmp_path.iterdir()
    run("validate", built)
    names = {f: zipfile.ZipFile(f).namelist() for f in (built, extension)}
    assert sorted(names[built]) == sorted(names[extension])


TRACES = """
def traces():
    "all places of Blender's where an add-on may leave something"
    handlers, timers = bpy.app.handlers, bpy.app.timers
    found = {n: sorted(f.__module__ for f in getattr(handlers, n)) for n in dir(handlers)
             if isinstance(getattr(handlers, n), list)}
    for t in dir(bpy.types):
        cls = getattr(bpy.types, t)
        draws = getattr(getattr(cls, "draw", None), "_draw_funcs", None)
        found["draw " + t] = sorted(f.__module__ for f in draws or [] if f.__module__[:6] != "bl_ui.")
        if t in ("Scene", "Object", "WindowManager", "Collection", "Mesh", "PointCloud", "Camera", "Material",
                 "Action", "Text", "Image", "NodeTree", "NodesModifier", "World", "ID", "Screen", "WorkSpace"):
            found["properties " + t] = sorted(cls.bl_rna.properties.keys()) + sorted(dir(cls))
    found["types"] = sorted(x for x in dir(bpy.types) if "__" not in x)
    found["operators"] = sorted(dir(bpy.ops.timesplat))
    found["classes"] = sorted(c.__name__ for base in (bpy.types.Operator, bpy.types.Panel, bpy.types.Menu,
        bpy.types.PropertyGroup, bpy.types.AddonPreferences, bpy.types.FileHandler)
        for c in base.__subclasses__() if c.is_registered and "timesplat" in c.__module__)
    keys = bpy.context.window_manager.keyconfigs.addon  # none in background
    found["keys"] = [[k.name, len(k.keymap_items)] for k in (keys.keymaps if keys else []) if k.keymap_items]
    found["names"] = sorted(bpy.app.driver_namespace)
    return {k: v for k, v in found.items() if v}
"""
USE = """
import time
def use():
    done = bpy.ops.timesplat.import_asset(filepath=sys.argv[1], use_clip=True, look="Splats")
    ob = bpy.context.object
    said = dict(done=list(done), count=part("addon.asset.asset_object").asset_of(ob).xyz.shape[0], scale=list(ob.scale),
                at=list(ob.location), range=[bpy.context.scene.frame_start, bpy.context.scene.frame_end],
                fps=bpy.context.scene.render.fps / bpy.context.scene.render.fps_base)
    bpy.ops.timesplat.export_asset(filepath=sys.argv[3])
    bpy.ops.timesplat.reconstruct(method="lift", budget="ALL", refine=0, size=16, samples=1, every=200)
    return said
result = use()
try:
    bpy.ops.timesplat.import_asset(filepath=sys.argv[2])
except RuntimeError as e:
    result["refused"] = str(e)
folder = os.path.dirname(sys.modules[name].__file__)
result["strange"] = [[m, f] for m, f in ((m, getattr(x, "__file__", None) or "") for m, x in list(sys.modules.items()))
    if (f.startswith(folder) and m != name and not m.startswith(name + ".")) or m.split(".")[0] == "timesplat"]
result["heavy"] = sorted({m.split(".")[0] for m in sys.modules} & {"torch", "numba", "PIL", "triton", "safetensors"})
timers = [part("addon.runtime.jobs")._poll_jobs]
on, off = [], []
for _ in range(2):
    on.append(traces())
    bpy.ops.preferences.addon_disable(module=name)
    off.append(traces())
    result["timers"] = any(bpy.app.timers.is_registered(t) for t in timers)
    bpy.ops.preferences.addon_enable(module=name)
    use()
    timers.append(part("addon.runtime.jobs")._poll_jobs)
tell(**result, on=on, off=off, runs=os.listdir(bpy.utils.extension_path_user(name, path="runs", create=True)))
"""


def test_installed_it_works_in_its_own_namespace_and_goes_away_again(blender, installed, tmp_path):
    pytest.importorskip("torch")
    write_ply(tmp_path / "a.ply", make(77))
    (tmp_path / "bad.ply").write_bytes((tmp_path / "a.ply").read_bytes()[:-5])
    package = "" if REAL else 'bpy.ops.preferences.addon_enable(module="bl_pkg")\n'
    without = blender(TRACES + package + "tell(**traces())")
    told = installed(TRACES + USE, tmp_path / "a.ply", tmp_path / "bad.ply", tmp_path / "out.ply")
    assert told["done"] == ["FINISHED"] and told["count"] == 77 and len(read_ply(tmp_path / "out.ply")) > 0
    np.testing.assert_allclose(told["scale"] + told["at"], [2.5] * 3 + [1, -2, 3])
    assert told["range"] == [10, 33] and abs(told["fps"] - 23.976) < 1e-4
    assert "truncated" in told["refused"] and "bad.ply" in told["refused"] and "Traceback" not in told["refused"]
    assert told["strange"] == [] and told["heavy"] == [] and told["runs"] == [] and not told["timers"]
    for on, off in zip(told["on"], told["off"], strict=True):
        assert len(on["classes"]) > 10 and len(on["operators"]) > 5
        assert {k: v for k, v in off.items() if v != without.get(k)} == {}
