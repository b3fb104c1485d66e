# SPDX-License-Identifier: GPL-3.0-or-later
"""`blender -b scene.blend --command timesplat …`; where Blender is a Python module the same function is called."""

import os
import subprocess

import numpy as np
import pytest

from timesplat.datagen.sequence import read_sequence
from timesplat.model.io.ply import read_ply

from .helpers import REAL, TARGET

SCENE = """
for o in list(bpy.data.objects):
    bpy.data.objects.remove(o)
bpy.ops.mesh.primitive_uv_sphere_add(location=(3, 0, 0))
bpy.context.scene.frame_start, bpy.context.scene.frame_end = 1, 4
bpy.ops.object.mode_set(mode="EDIT")  # as many a file is saved
bpy.ops.wm.save_as_mainfile(filepath=sys.argv[1])
tell()
"""
CALL = """
bpy.ops.wm.open_mainfile(filepath=sys.argv[1])
tell(code=part("addon.command_line").main(sys.argv[2:]))
"""


@pytest.fixture
def command(installed, tmp_path):
    """command(*arguments) -> (exit code, what it said)"""
    scene = tmp_path / "scene.blend"
    installed(SCENE, scene)

    def run(*args):
        args = [str(a) for a in args]
        if REAL:
            env = {**os.environ, **installed.env, "BLENDER_USER_RESOURCES": str(installed.user)}
            line = [TARGET, "-b", str(scene), "--command", "timesplat", *args]
            done = subprocess.run(line, capture_output=True, text=True, env=env | {"TMPDIR": str(installed.tmp)})
            return done.returncode, done.stdout + done.stderr
        process = installed.start(CALL, scene, *args)
        said, _ = process.communicate(timeout=600)
        code = [line for line in said.splitlines() if line.startswith("RESULT")]
        return int(code[0].split(":")[1].strip(" }")) if code else process.returncode, said

    return run


def test_render(command, tmp_path):
    code, said = command("render", "--out", tmp_path / "s", "--size", 16, "--samples", 1, "--targets", 1, "--every", 1)
    assert code == 0 and "28 pictures" in said, said
    seq = read_sequence(tmp_path / "s")
    assert (
        seq.width == 16 and seq.tracks and len(seq.select(rig="coverage")) == 24 and len(seq.select(rig="target")) == 4
    )
    np.testing.assert_allclose(seq.normalisation.translation, [3, 0, 0], atol=1e-5)


RESULT = """
bpy.ops.wm.open_mainfile(filepath=sys.argv[1])
ob = bpy.data.objects["Timesplat"]
tell(kind=ob.type, clouds=part("addon.asset.display").has_point_clouds(),
     active=bpy.context.view_layer.objects.active == ob)
"""


def test_reconstruct(command, installed, tmp_path):
    pytest.importorskip("torch")
    options = ["--method", "lift", "--size", 32, "--samples", 1, "--budget", "ALL", "--refine", 0]
    code, said = command("reconstruct", *options, "--output", tmp_path / "a.ply", "--blend", tmp_path / "a.blend")
    assert code == 0 and "Gaussians in" in said and "%" in said, said
    asset = read_ply(tmp_path / "a.ply")
    assert len(asset) > 100 and (asset.clip.frame_start, asset.clip.frame_end) == (1, 4)
    told = installed(RESULT, tmp_path / "a.blend")
    assert told["active"] and told["kind"] == ("POINTCLOUD" if told["clouds"] else "MESH")


def test_what_cannot_be_done(command, tmp_path):
    for args, code, word in (
        (["reconstruct", "--method", "lift"], 2, "would be lost"),
        (["reconstruct", "--method", "magic"], 2, "invalid choice"),
        (["render", "--out", str(tmp_path / "s"), "--source", "COLLECTION"], 2, "no such collection"),
        (["render", "--help"], 0, "Cycles samples"),
    ):
        got, said = command(*args)
        assert got == code and word in said and "Traceback" not in said, (args, got, said)
    assert not (tmp_path / "s").exists()


BAKED = """
import shutil
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.mesh.primitive_cube_add(size=2)
cache = bpy.context.object.modifiers.new("c", "CLOTH").point_cache
bpy.ops.wm.save_as_mainfile(filepath=sys.argv[1])
cache.use_disk_cache, cache.frame_end = True, 13
with bpy.context.temp_override(point_cache=cache):
    bpy.ops.ptcache.bake(bake=True)
bpy.context.scene.frame_start = bpy.context.scene.frame_end = 13
bpy.ops.wm.save_mainfile()
tell(caches=[x for x in os.listdir(os.path.dirname(sys.argv[1])) if x.startswith("blendcache_")])
"""


def test_a_cache_on_the_disk_is_found(command, installed, tmp_path):
    """Blender looks for it in a folder that has the file's name."""
    assert installed(BAKED, tmp_path / "scene.blend")["caches"] == ["blendcache_scene"]
    code, said = command("render", "--out", tmp_path / "s", "--size", 16, "--samples", 1)
    assert code == 0, said
    assert read_sequence(tmp_path / "s").normalisation.translation[2] < -0.3
