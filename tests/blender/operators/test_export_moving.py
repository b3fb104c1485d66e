# SPDX-License-Identifier: GPL-3.0-or-later
"""File > Export of what moves: slices are what the timeline shows, and USD holds an object's own motion."""

import os
import sys

import numpy as np
import pytest

from timesplat.model.io import files as formats
from timesplat.model.io.asset import VISIBLE
from timesplat.model.io.ply import read_ply

from ..helpers import EXPORT


def test_slices_and_their_way_back(blender, folder):
    """A folder of slices, imported as a sequence, shows at each frame what the asset shows there."""
    code = """
scene.frame_start, scene.frame_end = 10, 33
done = [save("frames", format="SLICES"), save("one.splat"), save("frames.ply", format="SLICES")]
scene.frame_set(17)
done.append(save("seventeen.ply", format="SLICE"))
done.append(list(bpy.ops.timesplat.import_asset(filepath=folder + "frames", frame_start=10)))
new, graph = bpy.context.object, bpy.context.evaluated_depsgraph_get()
edit_asset = holding.asset_of(new)
shown = {}
for frame in (10, 17, 33):
    position, alpha = edit_asset.at(edit_asset.frame_to_time(frame))
    shown[frame] = (np.c_[position, np.ones(len(position))] @ np.array(new.matrix_world).T)[alpha >= 0.05, :3].tolist()
tell(done=done, shown=shown)
"""
    told = blender(EXPORT + code, folder)
    assert told["done"][:2] == [["FINISHED"]] * 2 and told["done"][3:] == [["FINISHED"]] * 2
    assert "exists already" in told["done"][2]
    assert sorted(os.listdir(folder / "frames")) == [f"frames_{f:04d}.ply" for f in range(10, 34)]
    assert (folder / "seventeen.ply").read_bytes() == (folder / "frames/frames_0017.ply").read_bytes()
    asset = read_ply(folder / "in.ply")
    for frame, got in told["shown"].items():
        xyz, opacity = asset.at(asset.frame_to_time(int(frame)))
        np.testing.assert_allclose(got, xyz[opacity >= VISIBLE] * 2.5 + [1, -2, 3], atol=2e-5)


TIMELINE = """
def key(owner, name, values):
    for frame, value in values.items():
        setattr(owner, name, value)
        owner.keyframe_insert(name, frame=frame)
def world():
    for i in bpy.context.evaluated_depsgraph_get().object_instances:  # where a mesh stands in, it is an instance of it
        if i.object.type == "POINTCLOUD" and (i.object.original == ob or i.parent and i.parent.original == ob):
            return [list(i.matrix_world @ p.co) for p in i.object.data.points]
    return []
def at(frames):
    found = {}
    for f in frames:
        scene.frame_set(f)
        found[f] = [world(), [list(r) for r in ob.matrix_world]]
    return found
said, operator = [], part("addon.operators.export_asset").TIMESPLAT_OT_export_asset
def write(self, *a, before=operator.write):
    said.append(before(self, *a))
    return said[-1]
operator.write = write
"""


@pytest.mark.parametrize("repeat", ["Hold", "Loop", "Ping-Pong"])
def test_slices_are_what_the_timeline_shows(blender, folder, repeat):
    """At every frame of the scene, with animated sliders and a place that is animated; grown from nothing."""
    code = f"""
modifier = sliders.asset_modifier(ob)
sliders.set_input(modifier, "Repeat", {repeat!r})
sliders.set_input(modifier, "Time Scale", 1.5)
def slide(name, values):
    for frame, value in values.items():
        sliders.set_input(modifier, name, value)
        owner, key = sliders.input_property(modifier, name)
        owner.keyframe_insert(key, frame=frame)
slide("Density", {{8: 1.0, 30: 0.4, 36: 0.0}})
slide("Opacity Cut", {{8: 0.0, 30: 0.3}})
key(ob, "location", {{8: (0, 0, 0), 40: (4, 0, 1)}})
key(ob, "scale", {{8: (0, 0, 0), 12: (2, 2, 2)}})
scene.frame_start, scene.frame_end = 8, 40
scene.frame_set(20, subframe=0.5)
done, now = save("frames", format="SLICES"), scene.frame_current_final
one = save("one.ply", format="SLICE"), world()
scene.frame_set(36)
save("none.splat")
scene.frame_set(20, subframe=0.5)
tell(done=done, now=now, one=one, refused=save("a.ply"), shown=at(range(8, 41)), said=said)
"""
    told = blender(EXPORT + TIMELINE + code, folder)
    assert told["done"] == ["FINISHED"] and told["now"] == 20.5
    shown = {f: w for f, (w, _) in told["shown"].items()} | {"one": told["one"][1]}
    counts = set()
    for frame, want in shown.items():
        name = "one.ply" if frame == "one" else f"frames/frames_{int(frame):04d}.ply"
        got = formats.read_asset(folder / name).asset
        if not want or frame == "8":  # a clear one stands in
            assert len(got) == 1 and got.opacity[0] < 1e-5
            continue
        counts.add(len(want))
        want = np.array(want)
        np.testing.assert_allclose(got.xyz, np.stack([want[:, 0], -want[:, 2], want[:, 1]], 1), atol=2e-5)
    assert told["said"][2] == ["WARNING", "Nothing is shown at frame 36; one clear Gaussian stands in."]
    assert len(counts) > 10 and len(os.listdir(folder / "frames")) == 33
    if repeat == "Hold":
        animated = "Animated, but in the file as at frame 20.5: Opacity Cut, Density, place."
        assert told["said"][-1][0] == "WARNING" and animated in told["said"][-1][1]
    else:
        assert f"Repeat is {repeat}" in told["refused"] and "export 3DGS PLY, all frames" in told["refused"]


def test_an_object_that_moves(blender, folder):
    """USD has its motion, in every mode and through its way back; a .ply has where it is now."""
    pytest.importorskip("pxr")
    from timesplat.model.io import usd_check, usd_read

    code = """
from mathutils import Euler, Matrix
parent = bpy.data.objects.new("Parent", None)
scene.collection.objects.link(parent)
key(parent, "rotation_euler", {10: (0, 0, 0), 30: (0.5, -4, 1)})
ob.parent = parent
key(ob, "location", {12: (1, 0, 0), 33: (1, 2, 3)})
scene.frame_set(20)
done = [save("now.ply"), save("a.usdz"), save("b.usda", mode="frames", half=True), save("c.usdc", mode="points")]
want = at(range(10, 34))
scene.frame_set(5)
done.append(list(bpy.ops.timesplat.import_asset(filepath=folder + "a.usdz", look="Points")))
ob = bpy.context.object
got = at(range(10, 34))
done.append(save("again.usdc"))
ob.parent = parent  # what turns may shear what is scaled
parent.scale = (1, 3, 1)
done += [save("sheared.usdc"), list(bpy.ops.timesplat.import_asset(filepath=folder + "sheared.usdc"))]
tell(done=done, want=want, got=got, said=said, keyed=bool(bpy.context.object.animation_data))
"""
    told = blender(EXPORT + TIMELINE + code, folder, env={"TIMESPLAT_PYTHON": sys.executable})
    assert told["done"] == [["FINISHED"]] * 8 and not told["keyed"]
    assert "Animated, but in the file as at frame 20: place." in told["said"][0][1]
    assert [level for level, _ in told["said"][1:]] == ["INFO"] * 5 and "valid USD" in told["said"][1][1]
    asset = read_ply(folder / "in.ply")
    for name in ("a.usdz", "b.usda", "c.usdc", "again.usdc"):
        assert usd_check.check_usd(folder / name) == []
        loaded = usd_read.load_usd(folder / name)
        got, motion = loaded.asset, loaded.motion
        for frame, (points, matrix) in told["want"].items():
            xyz, opacity = got.at(got.frame_to_time(int(frame)))
            xyz = (xyz * got.clip.scale + got.clip.translation)[opacity >= VISIBLE]
            M = motion[int(frame) - 10]
            place = np.array(matrix)
            if name != "b.usda":  # half precision moves a Gaussian across the limit of what is seen
                np.testing.assert_allclose(xyz @ M[:3, :3].T + M[:3, 3], points, atol=3e-4)
                np.testing.assert_allclose(told["got"][frame][0], points, atol=3e-5)
            now = asset.at(asset.frame_to_time(int(frame)))[0]
            np.testing.assert_allclose(
                (got.at(got.frame_to_time(int(frame)))[0] * got.clip.scale + got.clip.translation) @ M[:3, :3].T
                + M[:3, 3], now @ place[:3, :3].T + place[:3, 3], atol=5e-3 if name == "b.usda" else 3e-4,
            )  # fmt: skip
    got, place = read_ply(folder / "now.ply"), told["want"]["20"][0]
    xyz, opacity = got.at(got.frame_to_time(20))
    world = (xyz * got.clip.scale + got.clip.translation)[opacity >= VISIBLE]
    np.testing.assert_allclose(world, place, atol=3e-5)
