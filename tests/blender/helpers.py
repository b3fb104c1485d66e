# SPDX-License-Identifier: GPL-3.0-or-later
"""Runs Python inside a Blender of the tester's choice, each time in a new process.

TIMESPLAT_BLENDER names it: a `blender` executable (4.2 or newer), or a Python that has the bpy wheel; unset, it
is the Python that runs the tests. pytest and the worker stay in that Python in every case.
"""

import json
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np

from timesplat.model.io.asset import ARRAYS, STATIC_SIGMA_T, Asset, Clip
from timesplat.model.io.paths import Paths, multiply, rotate

ROOT = Path(__file__).resolve().parent.parent.parent
TARGET = os.environ.get("TIMESPLAT_BLENDER") or sys.executable
REAL = not Path(TARGET).name.startswith("python")  # an executable Blender, not a Python with bpy
CLIP = Clip(23.976, 10, 33, 2.5, (1.0, -2.0, 3.0), pixel=0.03)
EXTENSION = "bl_ext.user_default.timesplat"

HEAD = """
import atexit, importlib, importlib.util, json, os, sys
import bpy, numpy as np
if bpy.app.version < (5, 0) and not bpy.app.binary_path:
    atexit.register(os._exit, 0)  # last of all: these wheels crash or hang on their way out where a panel is registered
if "--" in sys.argv:  # Blender's own arguments stand before it
    sys.argv[1:] = sys.argv[sys.argv.index("--") + 1:]
def tell(**d): print("RESULT" + json.dumps(d), flush=True)
def part(path): return importlib.import_module(name + "." + path)
sys.meta_path[:] = [f for f in sys.meta_path if "editable" not in repr(f)]  # an installed timesplat counts for nothing
assert not any(os.path.isdir(os.path.join(p, "timesplat")) for p in sys.path)
"""
CHECKOUT = f"""
name, folder = "timesplat", {str(ROOT)!r}
spec = importlib.util.spec_from_file_location(name, folder + "/__init__.py", submodule_search_locations=[folder])
sys.modules[name] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(sys.modules[name])
"""
# The wheel never reads user preferences, so there the extension is switched on at each start.
ENABLED = f"""
name = {EXTENSION!r}
if not bpy.app.binary_path:
    bpy.ops.preferences.addon_enable(module="bl_pkg")
    bpy.ops.preferences.addon_enable(module=name)
assert name in bpy.context.preferences.addons and name in sys.modules
"""


def start(code: str, args, folder: Path, env: dict) -> subprocess.Popen:
    """Starts TARGET on a script; its profile is <folder>/user, its temporary folder <folder>/tmp."""
    (folder / "tmp").mkdir(exist_ok=True)
    script = folder / "script.py"
    script.write_text(code)
    command = ["-b", "--python-exit-code", "1", "--python", script, "--"] if REAL else [script]
    env = {**os.environ, "BLENDER_USER_RESOURCES": str(folder / "user"), "TMPDIR": str(folder / "tmp"), **env}
    return subprocess.Popen(
        [TARGET, *map(str, [*command, *args])], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=env
    )


class Runner:
    """`run(code, *args, env=None)` runs `code` in a new Blender and gives the dict that it hands to `tell(**)`.

    The code finds `bpy`, `np`, `json`, `os`, `sys`, its arguments as strings from sys.argv[1] on, and the package
    under the name `name`: `part("addon.asset.display")` imports a room of it. The folders `user` (the profile) and
    `tmp` stay from run to run of a test."""

    def __init__(self, folder: Path, head: str, env: dict | None = None) -> None:
        self.folder, self.head, self.env = folder, head, env or {}
        self.user, self.tmp = folder / "user", folder / "tmp"
        folder.mkdir(exist_ok=True)

    def start(self, code: str, *args, env: dict | None = None) -> subprocess.Popen:
        """The same without waiting: for tests that end Blender themselves."""
        return start(HEAD + self.head + textwrap.dedent(code), args, self.folder, {**self.env, **(env or {})})

    def __call__(self, code: str, *args, env: dict | None = None, timeout: float = 600) -> dict:
        process = self.start(code, *args, env=env)
        try:
            said, _ = process.communicate(timeout=timeout)
        except subprocess.TimeoutExpired:
            process.kill()
            raise AssertionError(f"Blender did not end: {process.communicate()[0]}") from None
        lines = [x for x in said.splitlines() if x.startswith("RESULT")]
        assert process.returncode == 0 and lines, said
        return json.loads(lines[-1].removeprefix("RESULT"))


def make(n=300, seed=0, clip=CLIP) -> Asset:
    """A random asset of `n` Gaussians over the whole normalised cube."""
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


def make_tracked(n=300, seed=0, clip=CLIP) -> Asset:
    """A random asset of `n` Gaussians on 20 paths of 1 to 6 knots; most of these are there for a part of the clip, from
    one whole frame to another, and turn by up to a third of a round from knot to knot."""
    r = np.random.default_rng(seed)
    p = 20
    count = r.integers(1, 7, p)
    count[0] = 1
    last = clip.frame_end - clip.frame_start
    start, end = np.sort(r.permuted(np.tile(np.arange(last + 1), (p, 1)), axis=1)[:, :2] / last * 2 - 1, axis=1).T
    start[:4], end[:4] = -1, 1
    step = np.concatenate([np.ones((count.sum(), 1)), r.uniform(-0.4, 0.4, (count.sum(), 3))], 1)
    step /= np.linalg.norm(step, axis=1, keepdims=True)
    for i in np.setdiff1d(np.arange(count.sum()), np.cumsum(count) - count):
        step[i] = multiply(step[i], step[i - 1])
        step[i] *= np.sign(step[i] @ step[i - 1])
    place = r.uniform(-0.8, 0.8, (count.sum(), 3))
    single = (x.astype(np.float32) for x in (start, end))
    paths = Paths(*single, count.astype(np.int32), place.astype(np.float32), step.astype(np.float32))

    path = (r.permutation(n) % p).astype(np.int32)
    t = r.uniform(start[path], end[path]).astype(np.float32)
    at, turn = paths.at(t, path)
    rides = {"xyz": at + rotate(turn, r.normal(0, 0.1, (n, 3)).astype(np.float32)), "t": t}
    rides |= {"velocity": np.zeros((n, 3)), "sigma_t": np.full(n, STATIC_SIGMA_T)}
    looks = {k: getattr(make(n, seed), k) for k in ("scale", "rotation", "rgb", "opacity")}
    arrays = {k: a.astype(np.float32) for k, a in (rides | looks).items()}
    return Asset(**arrays, clip=clip, path=path, paths=paths)


# An asset as an object, and `save`, which exports it from the File menu.
EXPORT = """
import atexit
part("addon").register()
atexit.register(part("addon").unregister)  # bpy 4.2 crashes at its end otherwise
display, sliders, edit, holding = (part(f"addon.asset.{x}") for x in ("display", "sliders", "edit", "asset_object"))
ply = part("model.io.ply")
folder = sys.argv[1] + os.sep
ob = display.add_asset(ply.read_ply(folder + "in.ply"), "Walk. 1", look="Points")
scene = bpy.context.scene
def save(name, **options):
    try:
        return list(bpy.ops.timesplat.export_asset(filepath=folder + name, **options))
    except RuntimeError as e:
        return str(e).strip().removeprefix("Error: ")
"""


def same(got, want, atol=4e-6, rtol=4e-6):
    for name in ARRAYS:
        np.testing.assert_allclose(getattr(got, name), getattr(want, name), rtol=rtol, atol=atol, err_msg=name)
