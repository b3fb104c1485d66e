# SPDX-License-Identifier: GPL-3.0-or-later
"""The point cloud and its nodes against numpy."""

import json
import math
import textwrap
from dataclasses import replace

import numpy as np
import pytest

from timesplat.model.io.asset import SH_C0, linear_from_srgb
from timesplat.model.io.ply import read_ply, write_ply

from ..helpers import make
from .evaluated import READ, expected_time

EVALUATE = """
display, sliders = part("addon.asset.display"), part("addon.asset.sliders")
asset = part("model.io.ply").read_ply(sys.argv[1])
bpy.ops.wm.read_factory_settings(use_empty=True)
ob = display.add_asset(asset, "a", look="Points", cut=0.05)
scene, out = bpy.context.scene, {}
for look in ("Points", "Splats"):
    sliders.set_input(ob.modifiers[0], "Look", look)
    for frame in (10.0, 16.25, 21.5, 32.9, 33.0, 2.0, 40.5):
        scene.frame_set(int(frame), subframe=frame % 1)
        out[f"{look} {frame}"] = shown(ob, "position", "gs_alpha", "radius", "gs_color")
tell(frames=out, type=ob.type, clouds=part("addon.asset.display").has_point_clouds(), selected=ob.select_get(),
     names=[a.name for a in ob.data.attributes], meshes=sum(m.name != "Timesplat Ellipsoid" for m in bpy.data.meshes),
     bounces=scene.cycles.transparent_max_bounces, torch="torch" in sys.modules)
"""


def test_evaluated_attributes_are_those_of_numpy(blender, tmp_path):
    asset = make()
    write_ply(tmp_path / "a.ply", asset)
    asset = read_ply(tmp_path / "a.ply")
    told = blender(READ + EVALUATE, tmp_path / "a.ply")
    assert told["type"] == ("POINTCLOUD" if told["clouds"] else "MESH") and told["selected"]
    assert told["meshes"] == (not told["clouds"]) and told["bounces"] >= 512 and not told["torch"]
    expected = {"velocity", "t", "sigma_t", "opacity", "scale", "rotation", "color", "radius", "reach", "order"}
    assert {f"gs_{x}" for x in expected} <= set(told["names"]) and "velocity" not in told["names"]
    for key, got in told["frames"].items():
        look, frame = key.split()
        position, opacity = asset.at(np.clip(asset.frame_to_time(float(frame)), -1, 1))  # held at the ends
        seen = opacity >= 0.05
        assert 20 < seen.sum() < len(asset)
        np.testing.assert_allclose(got["position"], position[seen], atol=1e-5)
        np.testing.assert_allclose(got["gs_alpha"], opacity[seen], atol=1e-5)
        np.testing.assert_allclose(np.array(got["gs_color"])[:, :3], linear_from_srgb(asset.rgb)[seen], atol=1e-6)
        s = np.sort(asset.soft_scale()[seen], 1)
        np.testing.assert_allclose(got["radius"], 1.5 * s[:, 1] if look == "Points" else 3 * s[:, 2], rtol=1e-5)
        np.testing.assert_allclose(got["world"], position[seen][:5] * 2.5 + [1, -2, 3], atol=2e-5)
        assert got["material"].endswith(look)


SLIDERS = """
display, sliders = part("addon.asset.display"), part("addon.asset.sliders")
asset, cases = part("model.io.ply").read_ply(sys.argv[1]), json.loads(sys.argv[2])
bpy.ops.wm.read_factory_settings(use_empty=True)
ob = display.add_asset(asset, "a", look="Points", cut=0.05)
modifier, scene, out = sliders.asset_modifier(ob), bpy.context.scene, []
order = np.empty(len(asset), np.float32)
ob.data.attributes["gs_order"].data.foreach_get("value", order)
start = {name: sliders.get_input(modifier, name) for name in sliders.SLIDERS}
for case in cases:
    for name, value in {**start, **case["set"]}.items():
        sliders.set_input(modifier, name, value)
    assert {**start, **case["set"]}.keys() == {n: sliders.get_input(modifier, n) for n in sliders.SLIDERS}.keys()
    scene.frame_set(int(case["frame"] // 1), subframe=case["frame"] % 1)
    out.append(shown(ob, "position", "gs_alpha"))
tell(out=out, order=order.tolist(), start=start)
"""
RETIMED = [
    {"Time Offset": 5.5},
    {"Time Scale": 2.0, "Time Offset": -3.0},
    {"Time Scale": -0.5, "Time Offset": 40.0},
    {"Time Scale": 0.0},
    {"Repeat": "Loop"},
    {"Repeat": "Loop", "Time Scale": -1.5},
    {"Repeat": "Ping-Pong", "Time Offset": 1.25},
    {"Repeat": "Ping-Pong", "Time Scale": -3.0},
    {"Repeat": "Loop", "Frame Start": 12.0, "Frame End": 12.0},
    {"Frame Start": 14.5, "Frame End": 20.25, "Repeat": "Ping-Pong"},
]
CHOSEN = [
    {"Density": 0.0},
    {"Density": 0.3},
    {"Density": 0.7},
    {"Lifetime Scale": 2.5},
    {"Lifetime Scale": 0.2, "Opacity Cut": 0.3},
    {"Crop": True, "Crop Min": [-0.5, -0.2, -1.0], "Crop Max": [0.4, 0.9, 0.3]},
    {"Crop": False, "Crop Min": [-0.5, -0.2, -1.0], "Crop Max": [0.4, 0.9, 0.3]},
    {"Crop": True, "Density": 0.5, "Time Scale": 0.5},
]
FRAMES = (-40.75, 10.0, 21.5, 33.0, 34.5, 57.25, 101.0)


def test_every_slider_does_what_numpy_says(blender, tmp_path):
    asset = make(200)
    write_ply(tmp_path / "a.ply", asset)
    asset = read_ply(tmp_path / "a.ply")
    cases = [{"set": c, "frame": f} for c in RETIMED for f in FRAMES]
    cases += [{"set": c, "frame": f} for c in CHOSEN for f in (15.0, 24.5)]
    told = blender(READ + SLIDERS, tmp_path / "a.ply", json.dumps(cases))
    order = np.array(told["order"])
    assert sorted(order) == pytest.approx(np.arange(200) / 200)
    assert told["start"]["Frame Start"] == 10 and told["start"]["Repeat"] == "Hold"
    for case, got in zip(cases, told["out"], strict=True):
        s = told["start"] | case["set"]
        alive = replace(asset, sigma_t=asset.sigma_t * s["Lifetime Scale"])
        position, opacity = alive.at(expected_time(s, case["frame"]))
        inside = ((asset.xyz >= s["Crop Min"]) & (asset.xyz <= s["Crop Max"])).all(1)
        seen = (opacity >= s["Opacity Cut"]) & (order < s["Density"]) & (inside | (not s["Crop"]))
        assert s["Density"] == 0 or 0 < seen.sum() < 200
        got = got if "position" in got else {"position": np.empty((0, 3)), "gs_alpha": []}
        np.testing.assert_allclose(got["position"], position[seen], atol=2e-5, err_msg=str(case))
        np.testing.assert_allclose(got["gs_alpha"], opacity[seen], atol=1e-4, err_msg=str(case))


def test_it_plays_without_the_add_on_and_sliders_can_be_keyed(blender, tmp_path):
    asset = make(200)
    write_ply(tmp_path / "a.ply", asset)
    save = """
    display, sliders = part("addon.asset.display"), part("addon.asset.sliders")
    asset = part("model.io.ply").read_ply(sys.argv[1])
    bpy.ops.wm.read_factory_settings(use_empty=True)
    ob = display.add_asset(asset, "a", look="Points", cut=0.05)
    for frame, value in ((10, 0.0), (30, 20.0)):
        owner, key = sliders.input_property(sliders.asset_modifier(ob), "Time Offset")
        sliders.set_input(sliders.asset_modifier(ob), "Time Offset", value)
        assert owner.keyframe_insert(key, frame=frame)
    bpy.ops.wm.save_as_mainfile(filepath=sys.argv[2])
    tell()
    """
    blender(save, tmp_path / "a.ply", tmp_path / "a.blend")
    play = """
    bpy.ops.wm.open_mainfile(filepath=sys.argv[1])
    ob, scene, out = bpy.data.objects["a"], bpy.context.scene, {}
    for frame in (10, 20, 30, 55):
        scene.frame_set(frame)
        out[frame] = shown(ob, "position")
    tell(out=out, ours=[m for m in sys.modules if m.startswith("timesplat.")])
    """
    told = blender(READ + textwrap.dedent(play), tmp_path / "a.blend")
    assert told["ours"] == []
    asset = read_ply(tmp_path / "a.ply")
    for frame, offset in (("10", 0), ("20", 10), ("30", 20), ("55", 20)):
        position, opacity = asset.at(np.clip(asset.frame_to_time(float(frame) - offset), -1, 1))
        np.testing.assert_allclose(told["out"][frame]["position"], position[opacity >= 0.05], atol=1e-4)


NATIVE = """
display, nodes, sliders = (part(f"addon.asset.{x}") for x in ("display", "nodes", "sliders"))
asset = part("model.io.ply").read_ply(sys.argv[1])
if bpy.app.version < (5, 2):
    tell(old=True)
    sys.exit()
bpy.ops.wm.read_factory_settings(use_empty=True)
ob = display.add_asset(asset, "a", look="Points", cut=0.05)
if not sliders.NATIVE:  # what Blender 5.3 has in the group
    display.write_attributes(ob.data, nodes.native_attributes(asset))
tree = sliders.asset_modifier(ob).node_group = sliders.asset_modifier(ob).node_group.copy()
n = nodes.Nodes(tree)
placed, end = (next(x for x in tree.nodes if x.bl_idname == k) for k in ("GeometryNodeSetPosition", "NodeGroupOutput"))
n.put(end.inputs[0], nodes.native_splats(n, placed.outputs[0]))
bpy.context.scene.frame_set(20, subframe=0.5)
tell(old=False, got=shown(ob, "position", "scale", "rotation", "radiance:base"))
"""


def test_blenders_own_splats_get_the_attributes_that_they_are_known_by(blender, tmp_path):
    """Names, types and meanings as Blender 5.3's importers write them; 5.2 has the types already, not the looks."""
    write_ply(tmp_path / "a.ply", make())
    told = blender(READ + NATIVE, tmp_path / "a.ply")
    if told["old"]:
        pytest.skip("before Blender 5.2 there are no attributes of four numbers")
    asset, got = read_ply(tmp_path / "a.ply"), told["got"]
    position, opacity = asset.at(asset.frame_to_time(20.5))
    seen = opacity >= 0.05
    np.testing.assert_allclose(got["position"], position[seen], atol=1e-5)
    np.testing.assert_allclose(got["scale"], asset.soft_scale()[seen], rtol=1e-5)
    np.testing.assert_allclose(got["rotation"], asset.rotation[seen], atol=1e-6)
    base = np.concatenate([(asset.rgb - 0.5) / SH_C0, opacity[:, None]], 1)[seen]
    np.testing.assert_allclose(got["radiance:base"], base, atol=1e-5)


def test_the_clip_is_placed_on_fractional_rates(blender):
    code = """
    from timesplat.addon.asset.display import play_clip
    from timesplat.model.io.asset import Clip
    rates = []
    for fps in (24.0, 23.976, 29.97, 12.5, 0.5, 120.0):
        play_clip(bpy.context.scene, Clip(fps, 3, 9))
        rates.append(bpy.context.scene.render.fps / bpy.context.scene.render.fps_base)
    tell(rates=rates)
    """
    for rate, fps in zip(blender(code)["rates"], (24.0, 23.976, 29.97, 12.5, 0.5, 120.0), strict=True):
        assert math.isclose(rate, fps, rel_tol=1e-5)
