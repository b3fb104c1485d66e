# SPDX-License-Identifier: GPL-3.0-or-later
"""The add-on inside Blender: every test that needs bpy runs it in a process of its own."""

import json
import math
import os
import subprocess
import sys
import textwrap
import zipfile
from fnmatch import fnmatch
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from timesplat.datagen.rigs import spherical
from timesplat.datagen.sequence import focal_from_fov, opengl_to_opencv
from timesplat.model.asset import Asset, Clip, linear_from_srgb, read_ply, rotation_matrices, write_ply

ROOT = Path(__file__).resolve().parent.parent
CLIP = Clip(23.976, 10, 33, 2.5, (1.0, -2.0, 3.0), pixel=0.03)


def make(n=300, seed=0, clip=CLIP) -> Asset:
    r = np.random.default_rng(seed)
    q = r.normal(size=(n, 4))
    arrays = {
        "xyz": r.uniform(-0.8, 0.8, (n, 3)),
        "t": r.uniform(-1, 1, n),
        "velocity": r.normal(0, 0.3, (n, 3)),
        "sigma_t": r.uniform(0.02, 0.4, n),
        "scale": np.exp(r.uniform(-5, -2.5, (n, 3))),
        "rotation": q / np.linalg.norm(q, axis=1, keepdims=True),
        "rgb": r.uniform(0, 1, (n, 3)),
        "opacity": r.uniform(0.1, 0.99, n),
    }
    return Asset(**{k: a.astype(np.float32) for k, a in arrays.items()}, clip=clip)


def blender(code: str, *args, env=None, python=("-c",)) -> dict:
    """Runs code with bpy in a new process; gives the dict that it hands to `tell`."""
    head = "import json, sys, bpy, numpy as np\ndef tell(**d): print('RESULT' + json.dumps(d))\n"
    command = [sys.executable, *python, head + textwrap.dedent(code), *map(str, args)]
    run = subprocess.run(command, capture_output=True, text=True, timeout=300, env={**os.environ, **(env or {})})
    lines = [x for x in run.stdout.splitlines() if x.startswith("RESULT")]
    assert run.returncode == 0 and lines, run.stdout + run.stderr
    return json.loads(lines[-1].removeprefix("RESULT"))


# ---------------------------------------------------------------- display

EVALUATE = """
from timesplat.addon import display
from timesplat.model.asset import read_ply
bpy.ops.wm.read_factory_settings(use_empty=True)
asset = read_ply(sys.argv[1])
ob = display.add_asset(asset, "a", look="Points", cut=0.05)
scene, out = bpy.context.scene, {}
def read(data, name, width, key):
    a = np.empty(len(data.points) * width, np.float32)
    data.attributes[name].data.foreach_get(key, a)
    return a.reshape(-1, width).tolist() if width > 1 else a.tolist()
for look in ("Points", "Splats"):
    display.set_input(ob.modifiers[0], "Look", display.LOOKS.index(look))
    for frame in (10.0, 16.25, 21.5, 32.9, 33.0, 2.0, 40.5):
        scene.frame_set(int(frame), subframe=frame % 1)
        ev = ob.evaluated_get(bpy.context.evaluated_depsgraph_get())
        out[f"{look} {frame}"] = {
            "position": read(ev.data, "position", 3, "vector"),
            "alpha": read(ev.data, "gs_alpha", 1, "value"),
            "radius": read(ev.data, "radius", 1, "value"),
            "color": read(ev.data, "gs_color", 4, "color"),
            "world": [list(ev.matrix_world @ p.co) for p in ev.data.points][:5],
            "material": ev.data.materials[0].name if len(ev.data.materials) else "",
        }
tell(frames=out, type=ob.type, selected=ob.select_get(), names=[a.name for a in ob.data.attributes],
     meshes=len(bpy.data.meshes), bounces=scene.cycles.transparent_max_bounces, torch="torch" in sys.modules)
"""


def test_evaluated_attributes_are_those_of_numpy(tmp_path):
    asset = make()
    write_ply(tmp_path / "a.ply", asset)
    asset = read_ply(tmp_path / "a.ply")
    told = blender(EVALUATE, tmp_path / "a.ply")
    assert told["type"] == "POINTCLOUD" and told["selected"] and told["meshes"] == 0
    assert told["bounces"] >= 512 and not told["torch"]
    expected = {"velocity", "t", "sigma_t", "opacity", "scale", "rotation", "color", "radius", "reach"}
    assert {f"gs_{x}" for x in expected} <= set(told["names"]) and "velocity" not in told["names"]
    for key, got in told["frames"].items():
        look, frame = key.split()
        position, opacity = asset.at(np.clip(asset.frame_to_time(float(frame)), -1, 1))  # held at the ends
        seen = opacity >= 0.05
        assert 20 < seen.sum() < len(asset)
        np.testing.assert_allclose(got["position"], position[seen], atol=1e-5)
        np.testing.assert_allclose(got["alpha"], opacity[seen], atol=1e-5)
        np.testing.assert_allclose(np.array(got["color"])[:, :3], linear_from_srgb(asset.rgb)[seen], atol=1e-6)
        s = np.sort(asset.soft_scale()[seen], 1)
        np.testing.assert_allclose(got["radius"], s[:, 1] if look == "Points" else 3 * s[:, 2], rtol=1e-5)
        np.testing.assert_allclose(got["world"], position[seen][:5] * 2.5 + [1, -2, 3], atol=2e-5)


RENDER = """
from timesplat.addon import display
display.save_blend(sys.argv[1], sys.argv[2])
bpy.ops.wm.open_mainfile(filepath=sys.argv[2])
scene = bpy.context.scene
ob = next(o for o in bpy.data.objects if o.type == "POINTCLOUD")
display.set_input(ob.modifiers[0], "Look", 2)
scene.render.resolution_x = scene.render.resolution_y = 48
scene.cycles.samples, scene.cycles.filter_width, scene.cycles.use_adaptive_sampling = 32, 0.01, False
scene.render.film_transparent = True
scene.frame_set(21, subframe=0.5)
image = scene.render.image_settings
image.file_format, image.color_depth = "OPEN_EXR", "32"
scene.render.filepath = sys.argv[3]
bpy.ops.render.render(write_still=True)
tell(range=[scene.frame_start, scene.frame_end], fps=scene.render.fps / scene.render.fps_base,
     transform=scene.view_settings.view_transform)
"""


def test_splats_are_rendered_as_the_formula_says(tmp_path):
    """Against a ray tracer of a few lines: linear light, front to back, α exp(-½ d²) along each ray."""
    OpenEXR = pytest.importorskip("OpenEXR")
    asset = make(60, seed=3)
    asset.sigma_t[:] = 1.0
    asset.scale[:] = np.exp(np.random.default_rng(1).uniform(-4, -1.6, asset.scale.shape))
    write_ply(tmp_path / "a.ply", asset)
    told = blender(RENDER, tmp_path / "a.ply", tmp_path / "a.blend", tmp_path / "a.exr")
    assert told["range"] == [10, 33] and abs(told["fps"] - 23.976) < 1e-4 and told["transform"] == "Standard"
    with OpenEXR.File(str(tmp_path / "a.exr")) as f:
        got = f.channels()["RGBA"].pixels

    size, c2w = 48, opengl_to_opencv(spherical(0, 0))
    position, alpha = (x.astype(float) for x in asset.at(asset.frame_to_time(21.5)))
    y, x = np.mgrid[:size, :size] + 0.5
    f = focal_from_fov(50, size)
    ray = np.stack([(x - size / 2) / f, (y - size / 2) / f, np.ones_like(x)], -1) @ c2w[:3, :3].T
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    scale = asset.soft_scale()
    reach = 3 * scale.max(1)
    offset = c2w[:3, 3] - position  # (N,3)
    M = (rotation_matrices(asset.rotation) / scale[:, None]).transpose(0, 2, 1)
    w = np.einsum("nij,yxj->nyxi", M, ray)
    u = np.einsum("nij,nj->ni", M, offset)[:, None, None]
    d2 = (np.cross(u, w) ** 2).sum(-1) / (w**2).sum(-1)
    b = np.einsum("ni,yxi->nyx", offset, ray)
    disc = b**2 - ((offset**2).sum(-1) - reach**2)[:, None, None]  # spheres are met at their front
    entry = np.where(disc > 0, -b - np.sqrt(np.maximum(disc, 0)), np.inf)
    a = np.where((disc > 0) & (alpha >= 0.05)[:, None, None], alpha[:, None, None] * np.exp(-0.5 * d2), 0)
    order = np.argsort(entry, 0)
    a = np.take_along_axis(a, order, 0)
    colour = linear_from_srgb(asset.rgb)[order]  # (N,H,W,3)
    through = np.cumprod(1 - a, 0)
    weight = a * np.concatenate([np.ones((1, size, size)), through[:-1]])
    expected = np.concatenate([(weight[..., None] * colour).sum(0), (1 - through[-1])[..., None]], -1)
    assert expected[..., 3].mean() > 0.15
    error = np.abs(got - expected)
    assert error.mean() < 2e-4 and error.max() < 0.03, (error.mean(), error.max())


# ---------------------------------------------------------------- as an extension

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


@pytest.fixture(scope="module")
def extension(tmp_path_factory):
    """The .zip, built by Blender's own builder from the working tree."""
    from timesplat.addon.package import build

    folder = tmp_path_factory.mktemp("extension")
    path = build(folder)
    assert os.listdir(folder) == [path.name]
    return path


def test_the_zip_holds_what_it_should_and_no_more(extension):
    names = zipfile.ZipFile(extension).namelist()
    strange = [n for n in names if not any(fnmatch(n, p) and n.count("/") == p.count("/") for p in ALLOWED)]
    assert not strange
    assert {*NEEDED, "model/worker.py"} <= set(names)
    assert extension.stat().st_size < 40e6


INSTALL = """
import os
sys.meta_path[:] = [f for f in sys.meta_path if "editable" not in repr(f)]  # the extension must do alone
assert not any(os.path.isdir(os.path.join(p, "timesplat")) for p in sys.path)
bpy.ops.preferences.addon_enable(module="bl_pkg")
bpy.ops.extensions.package_install_files(filepath=sys.argv[1], repo="user_default", enable_on_install=True)
name = "bl_ext.user_default.timesplat"
assert name in bpy.context.preferences.addons
"""

USE = """
done = bpy.ops.timesplat.import_ply(filepath=sys.argv[2], use_clip=True, look="Splats")
ob, scene = bpy.context.object, bpy.context.scene
result = dict(done=list(done), kind=ob.type, count=len(ob.data.points), scale=list(ob.scale), at=list(ob.location),
    range=[scene.frame_start, scene.frame_end], fps=scene.render.fps / scene.render.fps_base,
    label=scene.timesplat.bl_rna.name, modules=[m for m in sys.modules if m.split(".")[0] == "timesplat"])
try:
    bpy.ops.timesplat.import_ply(filepath=sys.argv[3])
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


def test_installed_it_imports_and_goes_away_again(extension, tmp_path):
    write_ply(tmp_path / "a.ply", make(77))
    (tmp_path / "bad.ply").write_bytes((tmp_path / "a.ply").read_bytes()[:-5])
    resources = {"BLENDER_USER_RESOURCES": str(tmp_path / "user")}
    told = blender(INSTALL + USE, extension, tmp_path / "a.ply", tmp_path / "bad.ply", env=resources)
    assert told["done"] == ["FINISHED"] and told["kind"] == "POINTCLOUD" and told["count"] == 77
    np.testing.assert_allclose(told["scale"] + told["at"], [2.5] * 3 + [1, -2, 3])
    assert told["range"] == [10, 33] and abs(told["fps"] - 23.976) < 1e-4
    assert "truncated" in told["refused"] and "bad.ply" in told["refused"] and "Traceback" not in told["refused"]
    assert told["ours"] == [] and len(told["again"]) >= 5 and not told["scene"]
    assert not any("timesplat" in m for m in told["left"])
    assert not told["torch"] and told["modules"] == []


# ---------------------------------------------------------------- Reconstruct

SCENE = """
import os, tempfile, time
bpy.ops.wm.read_factory_settings(use_empty=True)
"""
ANIMATE = """
scene = bpy.context.scene
scene.frame_start, scene.frame_end, scene.render.fps = 5, 20, 30
bpy.ops.mesh.primitive_uv_sphere_add(radius=0.5)
ball = bpy.context.object
for frame, x in ((5, 1.0), (20, 3.0)):
    ball.location = (x, 2, 3)
    ball.keyframe_insert("location", frame=frame)
for i in ball.animation_data.action.fcurves if hasattr(ball.animation_data.action, "fcurves") else \
        ball.animation_data.action.layers[0].strips[0].channelbags[0].fcurves:
    for k in i.keyframe_points:
        k.interpolation = "LINEAR"
scene.frame_set(9)
"""
RECONSTRUCT = """
done = bpy.ops.timesplat.reconstruct(method="lift", frames=8, size=48, samples=4, output=sys.argv[2])
ob = bpy.context.object
result = {}
for frame in (5, 12.5, 20):
    scene.frame_set(int(frame), subframe=frame % 1)
    ev = ob.evaluated_get(bpy.context.evaluated_depsgraph_get())
    points = np.array([ev.matrix_world @ p.co for p in ev.data.points])
    radius = np.linalg.norm(points - np.array(ball.matrix_world.translation), axis=1)
    result[frame] = [points.mean(0).tolist(), float(np.median(radius))]
count = len(bpy.data.objects), len(bpy.data.scenes), len(bpy.data.cameras)
runs = bpy.utils.extension_path_user(name, path="runs", create=True)
left = os.listdir(runs)
scene.frame_set(9)
camera = bpy.data.objects.new("Eye", bpy.data.cameras.new("Eye"))
scene.collection.objects.link(camera)
camera.location, camera.rotation_euler = (2, -1, 3), (np.pi / 2, 0, 0)
bpy.ops.object.select_all(action="DESELECT")
camera.select_set(True)
second = bpy.ops.timesplat.reconstruct(method="lift", frames=4, size=32, samples=2)
errors = {}
def refused(key, **options):
    try:
        bpy.ops.timesplat.reconstruct(method="lift", size=32, samples=1, frames=2, **options)
    except RuntimeError as e:
        errors[key] = str(e).strip()
camera.data.type = "ORTHO"
camera.select_set(True)
refused("ortho")
camera.select_set(False)
refused("nothing", only_selected=True)
os.environ["TIMESPLAT_PYTHON"] = "/nowhere/python"
refused("python")
os.environ["TIMESPLAT_PYTHON"] = "/bin/false"
refused("dies")
tell(done=list(done), second=list(second), frames=result, count=count, left=left + os.listdir(runs), errors=errors,
     frame=scene.frame_current, torch="torch" in sys.modules, objects=[o.name for o in bpy.data.objects])
"""


def test_reconstruct_headless_with_lift(extension, tmp_path):
    """A ball on a straight line, captured, lifted in a worker and back over the original."""
    pytest.importorskip("torch")
    env = {"BLENDER_USER_RESOURCES": str(tmp_path / "user"), "TIMESPLAT_PYTHON": sys.executable}
    told = blender(SCENE + INSTALL + ANIMATE + RECONSTRUCT, extension, tmp_path / "kept.ply", env=env)
    assert told["done"] == told["second"] == ["FINISHED"] and not told["torch"]
    for frame, x in (("5", 1), ("12.5", 2), ("20", 3)):
        mean, radius = told["frames"][frame]
        np.testing.assert_allclose(mean, [x, 2, 3], atol=0.25)
        assert abs(radius - 0.5) < 0.12  # eight pictures of 48 pixels
    assert told["count"] == [2, 1, 0] and told["left"] == []  # nothing stays but the asset
    kept = read_ply(tmp_path / "kept.ply")
    assert (kept.clip.frame_start, kept.clip.frame_end, kept.clip.fps) == (5, 20, 30)
    assert abs(kept.clip.scale - 1.5) < 0.01 and told["frame"] == 9
    errors = told["errors"]
    for key, word in (("ortho", "perspective"), ("nothing", "no mesh"), ("python", "no such file"), ("dies", "code 1")):
        assert word in errors[key] and "Traceback" not in errors[key] and "\n" not in errors[key], errors


MODAL = """
import os, time, types, tempfile
tempfile.tempdir = sys.argv[1]
import timesplat.addon
from timesplat.addon import process
from timesplat.addon.reconstruct import TIMESPLAT_OT_reconstruct as Operator
timesplat.addon.register()
bpy.context.scene.frame_end = 1
process.LAUNCH = '''
import json, sys, time
print(json.dumps({"event": "progress", "fraction": 0.5, "text": "half"}), flush=True)
time.sleep(99)
'''
Operator.execute = lambda self, context: self.invoke(context, None)  # in background nothing invokes
told = {}
for how in ("ESC", "button", "file", "dies"):
    if how == "dies":
        process.LAUNCH = "import sys; sys.exit('out of memory')"
    started = bpy.ops.timesplat.reconstruct(method="lift", size=16, samples=1)
    operator = Operator.active
    worker = operator.worker.process
    event = lambda kind: operator.modal(bpy.context, types.SimpleNamespace(type=kind))
    seen, end = [], None
    for _ in range(200):
        end = event("TIMER")
        seen.append(operator.fraction)
        if operator.fraction > 0.5 or end != {"PASS_THROUGH"}:
            break
        time.sleep(0.05)
    busy = [event("MOUSEMOVE") == {"PASS_THROUGH"}, bpy.ops.timesplat.reconstruct.poll()] if how != "dies" else []
    if how == "ESC":
        end = event("ESC")
    if how == "button":
        bpy.ops.timesplat.cancel()
        end = event("MOUSEMOVE")
    if how == "file":
        bpy.ops.wm.read_factory_settings()
        end = []
    told[how] = dict(started=list(started), last=seen[-1], busy=busy, end=list(end), dead=worker.poll() is not None,
                     free=Operator.active is None, left=os.listdir(sys.argv[1]))
tell(**told)
"""


def test_the_panels_button_never_blocks_and_can_be_cancelled(tmp_path):
    told = blender(MODAL, tmp_path)
    for how, t in told.items():
        assert t["started"] == ["RUNNING_MODAL"] and t["dead"] and t["free"] and t["left"] == [], (how, t)
        assert t["end"] == ([] if how == "file" else ["CANCELLED"]), (how, t)
        if how != "dies":
            assert t["last"] == pytest.approx(0.65) and t["busy"] == [True, False], (how, t)


SPREAD = """
from timesplat.addon.reconstruct import spread
tell(all=[[spread(1, e, n) for n in (1, 2, 8, 24)] for e in (1, 2, 24, 40, 250)])
"""


def test_frames_are_spread_evenly():
    for row, end in zip(blender(SPREAD)["all"], (1, 2, 24, 40, 250), strict=True):
        for frames, count in zip(row, (1, 2, 8, 24), strict=True):
            steps = {b - a for a, b in pairwise(frames)}
            assert frames[0] == 1 and len(frames) <= count and len(steps) <= 1
            if count > 1:
                assert frames[-1] <= end < frames[-1] + max([1, *steps])


KILL = """
import os, time
from pathlib import Path
from timesplat.addon import process
process.LAUNCH = '''
import json, subprocess, sys, time
child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(99)"])
print(json.dumps({"event": "progress", "pid": child.pid}), flush=True)
time.sleep(99)
'''
worker = process.Worker(sys.executable, {"sequence": "x"}, Path(sys.argv[1]))
events = worker.poll(20)
start = time.monotonic()
nothing = worker.poll()
waited = time.monotonic() - start
worker.kill()
time.sleep(0.3)
def alive(pid):
    try:
        return open(f"/proc/{pid}/stat").read().split(")")[-1].split()[0] not in "ZX"
    except OSError:
        return False
left = [alive(events[0]["pid"]), alive(worker.process.pid)]
tell(events=len(events), nothing=len(nothing), waited=waited, alive=left)
"""


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks at processes in /proc")
def test_cancel_kills_the_process_tree_and_polling_never_waits(tmp_path):
    told = blender(KILL, tmp_path)
    assert told["events"] == 1 and told["nothing"] == 0 and told["waited"] < 0.05
    assert told["alive"] == [False, False]


def test_the_clip_is_placed_on_fractional_rates():
    code = """
    from timesplat.addon.display import play_clip
    from timesplat.model.asset import Clip
    rates = []
    for fps in (24.0, 23.976, 29.97, 12.5, 0.5, 120.0):
        play_clip(bpy.context.scene, Clip(fps, 3, 9))
        rates.append(bpy.context.scene.render.fps / bpy.context.scene.render.fps_base)
    tell(rates=rates)
    """
    for rate, fps in zip(blender(code)["rates"], (24.0, 23.976, 29.97, 12.5, 0.5, 120.0), strict=True):
        assert math.isclose(rate, fps, rel_tol=1e-5)
