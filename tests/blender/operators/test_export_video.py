# SPDX-License-Identifier: GPL-3.0-or-later
"""Films from Blender: a turntable, and what the scene's camera sees at each frame; cancelled they leave nothing."""

import os
import sys

import numpy as np
import pytest
from PIL import Image

from timesplat.model.io.asset import Asset, Clip
from timesplat.model.io.ply import write_ply

FILM = """
part("addon").register()
display, jobs = part("addon.asset.display"), part("addon.runtime.jobs")
folder = sys.argv[1] + os.sep
bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene
ob = display.add_asset(part("model.io.ply").read_ply(folder + "in.ply"), "Dot", look="Points")
def save(name, **options):
    try:
        return list(bpy.ops.timesplat.export_video(filepath=folder + name, **options))
    except RuntimeError as e:
        return str(e).strip().removeprefix("Error: ")
"""


@pytest.fixture
def folder(tmp_path):
    """One red Gaussian that goes from -1 to 1 along X in the world within the frames 3 to 6."""
    pytest.importorskip("torch")
    folder = tmp_path / "files"
    folder.mkdir()
    one = {"xyz": [[0, 0, 0]], "t": [0], "velocity": [[0.5, 0, 0]], "sigma_t": [1e4], "scale": [[0.05] * 3]}
    one |= {"rotation": [[1, 0, 0, 0]], "rgb": [[1, 0, 0]], "opacity": [0.99]}
    asset = Asset(**{k: np.array(v, np.float32) for k, v in one.items()}, clip=Clip(24, 3, 6, 2.0, (0.0, 0.0, 0.0)))
    write_ply(folder / "in.ply", asset)
    return folder


def centre(path) -> np.ndarray:
    pixels = np.asarray(Image.open(path)).astype(float)
    weight = pixels[..., 3]
    y, x = np.mgrid[: pixels.shape[0], : pixels.shape[1]] + 0.5
    return np.array([(x * weight).sum(), (y * weight).sum()]) / weight.sum()


def test_the_scenes_camera_sees_what_blender_says_it_sees(blender, folder):
    """Moving, shifted, fitted to the height: where `world_to_camera_view` has the dot, the picture has it."""
    code = """
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector
camera = bpy.data.objects.new("eye", bpy.data.cameras.new("eye"))
scene.collection.objects.link(camera)
scene.camera = camera
camera.rotation_euler = (1.4, 0.1, 0.05)
camera.data.shift_x, camera.data.shift_y = 0.1, -0.07
for frame, x in ((2, 0.0), (7, 1.0)):
    camera.location = (x, -8, 1)
    camera.keyframe_insert("location", frame=frame)
scene.render.resolution_x, scene.render.resolution_y = 300, 200
scene.frame_start, scene.frame_end = 2, 7
scene.frame_set(4)
done, seen = {}, {}
for fit in ("AUTO", "VERTICAL"):
    camera.data.sensor_fit = fit
    done[fit] = save(fit, kind="PNG", camera="SCENE", size=120, transparent=True)
    seen[fit] = []
    for frame in range(2, 8):
        scene.frame_set(frame)
        x = -1 + 2 * (min(max(frame, 3), 6) - 3) / 3
        seen[fit].append(list(world_to_camera_view(scene, camera, Vector((x, 0, 0)))[:2]))
    scene.frame_set(4)
camera.data.type = "ORTHO"
flat = save("flat.webp", camera="SCENE")
scene.camera = None
tell(done=done, seen=seen, flat=flat, blind=save("blind.webp", camera="SCENE"), now=scene.frame_current)
"""
    told = blender(FILM + code, folder)
    for fit, seen in told["seen"].items():
        assert told["done"][fit] == ["FINISHED"]
        names = sorted(os.listdir(folder / fit))
        assert names == [f"{fit}_{i:04d}.png" for i in range(1, 7)]
        for name, (x, y) in zip(names, seen, strict=True):
            assert Image.open(folder / fit / name).size == (120, 80)
            np.testing.assert_allclose(centre(folder / fit / name), (120 * x, 80 * (1 - y)), atol=0.4)
    assert "no perspective camera" in told["flat"] and "no perspective camera" in told["blind"] and told["now"] == 4
    assert sorted(os.listdir(folder)) == ["AUTO", "VERTICAL", "in.ply"]


def test_turntables_names_and_what_cannot_be(blender, folder):
    code = """
done = [save("a.webp", size=48, plays=2), save("b", kind="PNG", size=32, plays=1, transparent=True)]
message = jobs.JOBS[0].message
again = save("b", kind="PNG", size=32)
ob.location.x = 3
moved = save("c.mp4", kind="WEBP", size=32, plays=1)
operator = bpy.ops.timesplat.export_video
job = bpy.types.TIMESPLAT_OT_export_video
started = []
start = jobs.start
def cancelled(*a, **k):
    started.append(start(*a, **k))
    started[-1].advance(5.0)
    started[-1].cancel()
    return started[-1]
jobs.start = cancelled
stopped = save("d.webp", size=512)
jobs.start = start
os.environ["TIMESPLAT_PYTHON"] = "/nowhere/python"
tell(done=done, message=message, again=again, moved=moved, stopped=stopped, lost=save("e.webp"),
     left=os.listdir(part("addon.runtime.folders").user_folder("runs")))
"""
    told = blender(FILM + code, folder)
    assert told["done"] == [["FINISHED"]] * 2 and told["message"] == "a.webp: 8 pictures"
    assert "is not an empty folder" in told["again"] and told["moved"] == ["FINISHED"]
    assert "Cancelled" in told["stopped"] and "no such file" in told["lost"] and told["left"] == []
    with Image.open(folder / "a.webp") as film:
        assert film.size == (48, 48)
    assert sorted(os.listdir(folder)) == ["a.webp", "b", "c.webp", "in.ply"]
    assert sorted(os.listdir(folder / "b")) == [f"b_000{i}.png" for i in range(1, 5)]


def test_an_mp4(blender, folder):
    av = pytest.importorskip("av")
    told = blender(
        FILM + "tell(done=save('a.mp4', size=64, plays=1))", folder, env={"TIMESPLAT_PYTHON": sys.executable}
    )
    assert told["done"] == ["FINISHED"]
    with av.open(str(folder / "a.mp4")) as film:
        assert sum(1 for _ in film.decode(video=0)) == 4
