# SPDX-License-Identifier: GPL-3.0-or-later
"""The point cloud and its nodes against numpy; splats against a small ray tracer."""

import json
import math
import textwrap
from dataclasses import replace

import numpy as np
import pytest

from timesplat.datagen.rigs import spherical
from timesplat.datagen.sequence import focal_from_fov, opengl_to_opencv
from timesplat.model.io.asset import SH_C0, linear_from_srgb, rotation_matrices
from timesplat.model.io.ply import read_ply, write_ply

from .helpers import make

READ = """
def shown(ob, *names):
    \"\"\"Attributes of the evaluated point cloud at the scene's frame, as lists; {} where it is empty.\"\"\"
    graph = bpy.context.evaluated_depsgraph_get()
    for i in graph.object_instances:  # a mesh that stands in for a point cloud has it as an instance
        if i.object.type == "POINTCLOUD" and (i.object.original == ob or i.parent and i.parent.original == ob):
            data, out = i.object.data, {}
            names = names if len(data.points) else ()
            for name in names:
                attribute = data.attributes[name]
                key, width = {"FLOAT": ("value", 1), "FLOAT_VECTOR": ("vector", 3), "FLOAT_COLOR": ("color", 4),
                              "QUATERNION": ("value", 4)}[attribute.data_type]
                a = np.empty(len(data.points) * width, np.float32)
                attribute.data.foreach_get(key, a)
                out[name] = (a.reshape(-1, width) if width > 1 else a).tolist()
            out["world"] = [list(i.matrix_world @ p.co) for p in data.points][:5]
            out["material"] = data.materials[0].name if len(data.materials) and data.materials[0] else ""
            return out
    return {}
"""
EVALUATE = """
display, asset = part("addon.display"), part("model.asset").read_ply(sys.argv[1])
bpy.ops.wm.read_factory_settings(use_empty=True)
ob = display.add_asset(asset, "a", look="Points", cut=0.05)
scene, out = bpy.context.scene, {}
for look in ("Points", "Splats"):
    display.set_input(ob.modifiers[0], "Look", look)
    for frame in (10.0, 16.25, 21.5, 32.9, 33.0, 2.0, 40.5):
        scene.frame_set(int(frame), subframe=frame % 1)
        out[f"{look} {frame}"] = shown(ob, "position", "gs_alpha", "radius", "gs_color")
tell(frames=out, type=ob.type, clouds=part("addon.display").has_point_clouds(), selected=ob.select_get(),
     names=[a.name for a in ob.data.attributes], meshes=len(bpy.data.meshes),
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
display, nodes = part("addon.display"), part("addon.nodes")
asset, cases = part("model.asset").read_ply(sys.argv[1]), json.loads(sys.argv[2])
bpy.ops.wm.read_factory_settings(use_empty=True)
ob = display.add_asset(asset, "a", look="Points", cut=0.05)
modifier, scene, out = display.sampler(ob), bpy.context.scene, []
order = np.empty(len(asset), np.float32)
ob.data.attributes["gs_order"].data.foreach_get("value", order)
start = {name: nodes.get_input(modifier, name) for name in nodes.SLIDERS}
for case in cases:
    for name, value in {**start, **case["set"]}.items():
        display.set_input(modifier, name, value)
    assert {**start, **case["set"]}.keys() == {n: nodes.get_input(modifier, n) for n in nodes.SLIDERS}.keys()
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


def expected_time(s, frame):
    """The model time that the documentation promises, written another way than nodes.py and edit.py have it."""
    start, end = s["Frame Start"], s["Frame End"]
    moved = start + (frame - start - s["Time Offset"]) * s["Time Scale"]
    if start == end:
        return 0.0
    if s["Repeat"] == "Loop":  # shown once a round: every frame of the clip
        while moved < start:
            moved += end - start + 1
        while moved >= end + 1:
            moved -= end - start + 1
    while s["Repeat"] == "Ping-Pong" and not start <= moved <= end:
        moved = 2 * (start if moved < start else end) - moved
    return 2 * (min(max(moved, start), end) - start) / (end - start) - 1


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
    display, nodes, asset = part("addon.display"), part("addon.nodes"), part("model.asset").read_ply(sys.argv[1])
    bpy.ops.wm.read_factory_settings(use_empty=True)
    ob = display.add_asset(asset, "a", look="Points", cut=0.05)
    for frame, value in ((10, 0.0), (30, 20.0)):
        owner, key = nodes.rna(display.sampler(ob), "Time Offset")
        display.set_input(display.sampler(ob), "Time Offset", value)
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


PANEL = """
import types
display, nodes = part("addon.display"), part("addon.nodes")
bpy.ops.wm.read_factory_settings(use_empty=True)
ob = display.add_asset(part("model.asset").read_ply(sys.argv[1]), "a")
drawn, buttons, labels = {}, [], []
class Layout:
    def row(self, **_): return self
    column = row
    def label(self, text="", **_): labels.append(text)
    def operator(self, name, **_): return buttons.append(name) or types.SimpleNamespace()
    def operator_menu_enum(self, name, key, **_): buttons.append(name)
    def prop(self, owner, key, text=""):
        if key == "value":
            owner.bl_rna.properties[key]
        else:
            owner.path_resolve(key)
        drawn[text] = key
panel = types.SimpleNamespace(layout=Layout())
scene = bpy.context.scene
display.set_input(display.sampler(ob), "Crop", True)
for transform in ("AgX", "Standard"):
    scene.view_settings.view_transform = transform
    buttons.clear()
    display.TIMESPLAT_PT_result.draw(panel, bpy.context)
    if transform == "AgX":
        warned = list(buttons)
all_drawn = list(drawn)
drawn.clear()
display.set_input(display.sampler(ob), "Crop", False)
display.TIMESPLAT_PT_result.draw(panel, bpy.context)
scene.view_settings.view_transform = "AgX"
part("addon").register()
bpy.ops.timesplat.set_standard()
poll = [display.TIMESPLAT_PT_result.poll(bpy.context)]
bpy.ops.object.delete()
poll.append(display.TIMESPLAT_PT_result.poll(bpy.context))
tell(drawn=all_drawn, uncropped=list(drawn), sliders=list(nodes.SLIDERS), warned=warned, buttons=buttons,
     labels=labels, poll=poll, transform=scene.view_settings.view_transform)
part("addon").unregister()
"""


def test_the_panel_shows_the_modifiers_own_sliders(blender, tmp_path):
    write_ply(tmp_path / "a.ply", make(1234))
    told = blender(PANEL, tmp_path / "a.ply")
    assert told["drawn"] == told["sliders"] and told["labels"][0] == "1,234 Gaussians"
    assert told["uncropped"] == [x for x in told["sliders"] if x not in ("Crop Min", "Crop Max")]
    assert "timesplat.set_standard" in told["warned"] and "timesplat.set_standard" not in told["buttons"]
    assert {"timesplat.compare", "timesplat.bake", "timesplat.delete"} <= set(told["buttons"])
    assert told["transform"] == "Standard" and told["poll"] == [True, False]


NATIVE = """
display, nodes, asset = part("addon.display"), part("addon.nodes"), part("model.asset").read_ply(sys.argv[1])
if bpy.app.version < (5, 2):
    tell(old=True)
    sys.exit()
bpy.ops.wm.read_factory_settings(use_empty=True)
ob = display.add_asset(asset, "a", look="Points", cut=0.05)
if not nodes.NATIVE:  # what Blender 5.3 has in the group
    display.write_attributes(ob.data, nodes.native_attributes(asset))
tree = display.sampler(ob).node_group = display.sampler(ob).node_group.copy()
n = nodes.Nodes(tree)
placed, end = (next(x for x in tree.nodes if x.bl_idname == k) for k in ("GeometryNodeSetPosition", "NodeGroupOutput"))
n.put(end.inputs[0], nodes.native(n, placed.outputs[0]))
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


FOLLOW = """
display, asset = part("addon.display"), part("model.asset").read_ply(sys.argv[1])
bpy.ops.wm.read_factory_settings(use_empty=True)
scene, told = bpy.context.scene, {}
def made(name, parent=None):
    ob = bpy.data.objects.new(name, bpy.data.meshes.new(name))
    scene.collection.objects.link(ob)
    ob.parent = parent
    return ob
original, above = made("original"), made("above")
original.parent, original.location, original.scale = above, (1, 2, 3), (2,) * 3
above.location, above.rotation_euler = (0, 0, 5), (0.3, 0.2, 0.1)
ob = display.add_asset(asset, "a", look="Points")
before = shown(ob, "position")["world"]
told["did"] = display.follow(ob, original)
scene.frame_set(20)
scene.frame_set(1)
told["stays"] = np.abs(np.array(before) - shown(ob, "position")["world"]).max().item()
original.location.x += 10
bpy.context.view_layer.update()
told["axis"] = [10 * x for x in above.matrix_world.col[0][:3]]
told["moves"] = (np.array(shown(ob, "position")["world"]) - before).mean(0).tolist()
keyed, held, child, bone = made("keyed"), made("held"), made("child"), made("bone")
keyed.keyframe_insert("rotation_euler", frame=1)
held.constraints.new("COPY_LOCATION")
child.parent = keyed
driven, shape = made("driven"), made("shape")
driven.driver_add("location", 0)
shape.keyframe_insert("hide_render", frame=1)
told["refused"] = [display.follow(ob, x) for x in (keyed, held, child, driven, ob)]
told["shape"] = display.follow(ob, shape)
tell(**told)
"""


def test_it_follows_an_original_that_stands_still_by_itself(blender, tmp_path):
    write_ply(tmp_path / "a.ply", make())
    told = blender(READ + FOLLOW, tmp_path / "a.ply")
    assert told["did"] and told["shape"] and told["refused"] == [False] * 5
    assert told["stays"] < 1e-5 and told["moves"] == pytest.approx(told["axis"], abs=1e-4)


RENDER = """
from timesplat.addon import display
display.save_blend(sys.argv[1], sys.argv[2])
bpy.ops.wm.open_mainfile(filepath=sys.argv[2])
scene = bpy.context.scene
ob = next(o for o in bpy.data.objects if o.get("timesplat"))
display.set_input(ob.modifiers[0], "Look", "Splats")
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


def test_splats_are_rendered_as_the_formula_says(blender, tmp_path):
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


def test_the_clip_is_placed_on_fractional_rates(blender):
    code = """
    from timesplat.addon.display import play_clip
    from timesplat.model.io.asset import Clip
    rates = []
    for fps in (24.0, 23.976, 29.97, 12.5, 0.5, 120.0):
        play_clip(bpy.context.scene, Clip(fps, 3, 9))
        rates.append(bpy.context.scene.render.fps / bpy.context.scene.render.fps_base)
    tell(rates=rates)
    """
    for rate, fps in zip(blender(code)["rates"], (24.0, 23.976, 29.97, 12.5, 0.5, 120.0), strict=True):
        assert math.isclose(rate, fps, rel_tol=1e-5)
