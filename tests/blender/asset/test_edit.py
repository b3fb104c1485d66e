# SPDX-License-Identifier: GPL-3.0-or-later
"""What an object gives back, deleting, baking: against numpy."""

import json
import textwrap
from dataclasses import replace

import numpy as np
import pytest

from timesplat.model.io.asset import ARRAYS, Asset, Clip
from timesplat.model.io.ply import read_ply, write_ply

from ..helpers import make
from .evaluated import expected_time

START = """
part("addon").register()
display, sliders, edit = (part(f"addon.asset.{x}") for x in ("display", "sliders", "edit"))
holding, applying, attributes = (part(f"addon.asset.{x}") for x in ("asset_object", "apply_sliders", "attributes"))
asset_module = part("model.io.asset")
bpy.ops.wm.read_factory_settings(use_empty=True)
asset, scene = part("model.io.ply").read_ply(sys.argv[1]), bpy.context.scene
ob = display.add_asset(asset, "a", look="Points")
def save(asset, path):
    np.savez(path, **{k: getattr(asset, k) for k in asset_module.ARRAYS})
    c = asset.clip
    return [c.fps, c.frame_start, c.frame_end, c.scale, list(c.translation), c.pixel]
def set_all(values):
    for name, value in values.items():
        sliders.set_input(sliders.asset_modifier(ob), name, value)
def refused(call, *args, **options):
    try:
        call(*args, **options)
    except (RuntimeError, part("datagen.sequence").InputError) as e:
        return str(e).strip().splitlines()[-1]
"""
END = """
part("addon").unregister()  # older wheels of bpy do not end with classes of an add-on in them
"""


@pytest.fixture
def start(blender, tmp_path):
    """start(code, asset, *args) -> (the asset as read back from its file, what `tell` was given)."""

    def run(code, asset, *args):
        write_ply(tmp_path / "a.ply", asset)
        code = START + textwrap.dedent(code) + END
        return read_ply(tmp_path / "a.ply"), blender(code, tmp_path / "a.ply", tmp_path, *args)

    return run


def load(path):
    return dict(np.load(path))


def test_an_object_gives_the_asset_back(start, tmp_path):
    code = """
    out = sys.argv[2]
    first = save(holding.asset_of(ob), out + "/first.npz")
    ob.location.x += 3
    set_all({"Density": 0.5, "Crop": True, "Lifetime Scale": 3.0})
    second = save(holding.asset_of(ob), out + "/second.npz")
    plain = save(applying.with_sliders(ob), out + "/applied.npz")
    bpy.ops.wm.save_as_mainfile(filepath=out + "/a.blend")
    bpy.ops.wm.open_mainfile(filepath=out + "/a.blend")
    ob = bpy.data.objects["a"]
    third = save(holding.asset_of(ob), out + "/third.npz")
    ob.data.attributes.remove(ob.data.attributes["gs_t"])
    tell(clips=[first, second, third], broken=refused(holding.asset_of, ob), camera=refused(holding.asset_of, None))
    """
    asset, told = start(code, make(5000))
    clip = asset.clip
    for i, name in enumerate(("first", "second", "third")):
        assert Clip(*told["clips"][i][:4], tuple(told["clips"][i][4]), told["clips"][i][5]) == clip
        got = load(tmp_path / f"{name}.npz")
        for key in ARRAYS:
            if key == "rgb":
                np.testing.assert_allclose(got[key], asset.rgb, atol=1e-6)
            else:
                assert got[key].dtype == np.float32 and np.array_equal(got[key], getattr(asset, key)), key
    assert "gs_t" in told["broken"] and "\n" not in told["broken"] and "no Timesplat asset" in told["camera"]


def test_an_object_of_an_older_version_gives_its_asset_too(start, tmp_path):
    """It has no note of its clip and no order; its place and its modifier say the clip."""
    code = """
    del ob["timesplat_clip"]
    ob.data.attributes.remove(ob.data.attributes["gs_order"])
    ob.modifiers[0].node_group = group = ob.modifiers[0].node_group.copy()
    group.name = "Timesplat 1"
    for item in list(group.interface.items_tree):
        if item.item_type == "SOCKET" and item.name in ("Repeat", "Time Scale", "Crop"):
            group.interface.remove(item)
    clip = save(applying.with_sliders(ob), sys.argv[2] + "/old.npz")
    tell(clip=clip, fps=scene.render.fps, repeat=sliders.get_input(sliders.asset_modifier(ob), "Repeat"))
    """
    asset, told = start(code, make(50, clip=Clip(24, 10, 33, 2.5, (1.0, -2.0, 3.0))))
    assert told["clip"] == [told["fps"], 10, 33, 2.5, [1.0, -2.0, 3.0], 0.0] and told["repeat"] == "Hold"
    assert np.array_equal(load(tmp_path / "old.npz")["xyz"], asset.xyz)


CASES = [
    ({}, (10, 33)),
    ({"Time Offset": 5.0}, (15, 38)),
    ({"Time Scale": 0.5}, (10, 56)),
    ({"Time Scale": 2.0}, (10, 21)),  # the clip ends at 21.5
    ({"Time Scale": -1.0, "Time Offset": 23.0}, (10, 33)),
    ({"Time Offset": 0.25, "Time Scale": 0.75, "Lifetime Scale": 0.5}, (11, 40)),
    ({"Frame Start": 0.0, "Frame End": 10.5}, (0, 10)),
    ({"Crop": True, "Crop Min": [-0.5, -0.4, -1.0], "Crop Max": [0.7, 0.9, 0.3], "Density": 0.6}, (10, 33)),
    ({"Time Scale": 0.0}, (10, 33)),
    ({"Time Scale": 100.0, "Time Offset": 0.25}, (11, 11)),  # over before a whole frame
    ({"Opacity Cut": 0.0}, (10, 33)),
]


def test_applied_sliders_show_the_same(start, tmp_path):
    """At every frame of the new clip the applied asset is what the object with its sliders shows."""
    code = """
    cases, out, clips = json.loads(sys.argv[3]), sys.argv[2], []
    base = {name: sliders.get_input(sliders.asset_modifier(ob), name) for name in sliders.SLIDERS}
    for i, case in enumerate(cases):
        set_all({**base, **case})
        clips.append(save(applying.with_sliders(ob), f"{out}/{i}.npz"))
    order = attributes.read_attribute(ob.data, "gs_order").tolist()
    shown = {}
    for frame in (10.0, 17.5):
        set_all({**base, **cases[5]})
        position, mask = applying.shown_gaussians(ob, frame)
        shown[frame] = [position.tolist(), mask.tolist()]
    set_all({**base, "Repeat": "Loop"})
    loop = refused(applying.with_sliders, ob)
    set_all({**base, "Density": 0.0})
    tell(clips=clips, order=order, loop=loop, none=refused(applying.with_sliders, ob), base=base, shown=shown)
    """
    asset, told = start(code, make(400), json.dumps([c for c, _ in CASES]))
    order = np.array(told["order"], np.float32)
    for i, (case, frames) in enumerate(CASES):
        s, clip = told["base"] | case, told["clips"][i]
        assert tuple(clip[1:3]) == frames, case
        new = Asset(**load(tmp_path / f"{i}.npz"), clip=replace(asset.clip, frame_start=clip[1], frame_end=clip[2]))
        old = replace(asset, sigma_t=asset.sigma_t * np.float32(s["Lifetime Scale"]))
        inside = ((asset.xyz >= s["Crop Min"]) & (asset.xyz <= s["Crop Max"])).all(1)
        chosen = (order < np.float32(s["Density"])) & (inside | (not s["Crop"]))
        for frame in np.linspace(*frames, 9):
            position, opacity = old.at(expected_time(s, frame))
            seen = chosen & (opacity >= s["Opacity Cut"] + 1e-4)
            got, alpha = new.at(new.frame_to_time(frame))
            visible = alpha >= s["Opacity Cut"] + 1e-4
            assert 0 < seen.sum() == visible.sum(), (case, frame)
            np.testing.assert_allclose(got[visible], position[seen], atol=2e-5)
            np.testing.assert_allclose(alpha[visible], opacity[seen], atol=2e-4)
    assert "Loop" in told["loop"] and "Hold" in told["loop"] and "no Gaussian is left" in told["none"]
    for frame, (position, mask) in told["shown"].items():
        s = told["base"] | CASES[5][0]
        old = replace(asset, sigma_t=asset.sigma_t * np.float32(s["Lifetime Scale"]))
        expected, opacity = old.at(expected_time(s, float(frame)))
        np.testing.assert_allclose(position, expected, atol=1e-5)
        clear = np.abs(opacity - 0.05) > 1e-5
        assert np.array_equal(np.array(mask)[clear], (opacity >= 0.05)[clear])


DELETE = """
out, told = sys.argv[2], {}
mark = ob.data.attributes.new("mine", "INT", "POINT")
mark.data.foreach_set("value", np.arange(len(asset), dtype=np.int32))
ob.data["note"] = "kept"
twin = ob.copy()
scene.collection.objects.link(twin)
parent = bpy.data.objects.new("parent", None)
scene.collection.objects.link(parent)
ob.parent = parent
ob.keyframe_insert("location", frame=3)
def state():
    bpy.context.view_layer.update()
    return {"name": ob.name, "data": ob.data.name, "note": ob.data["note"], "twin": twin.data == ob.data,
            "parent": ob.parent.name, "animated": bool(ob.animation_data.action), "world": list(ob.matrix_world.col[3]),
            "materials": [m.name for m in ob.data.materials], "active": bpy.context.object.name,
            "selected": sorted(x.name for x in bpy.context.selected_objects), "kind": ob.data.rna_type.identifier,
            "sliders": {n: sliders.get_input(sliders.asset_modifier(ob), n) for n in sliders.SLIDERS},
            "objects": len(bpy.data.objects), "datas": len(bpy.data.meshes) + len(bpy.data.pointclouds)}
def left():
    ids = np.empty(len(ob.data.attributes["mine"].data), np.int32)
    ob.data.attributes["mine"].data.foreach_get("value", ids)
    return ids.tolist()
set_all({"Crop": True, "Crop Min": [-0.7, -0.7, -0.7], "Crop Max": [0.5, 0.6, 0.7]})
told["before"], told["left"] = state(), []
for options in ({"what": "OUTSIDE"}, {"what": "FAINT", "opacity": 0.3}, {"what": "LARGE", "size": 0.07}):
    told["done"] = list(bpy.ops.timesplat.delete(**options))
    told["left"].append(left())
told["again"] = list(bpy.ops.timesplat.delete(what="LARGE", size=0.07))
told["all"] = refused(bpy.ops.timesplat.delete, what="LARGE", size=0.0)
told["after"] = state()
save(holding.asset_of(ob), out + "/left.npz")
part("model.io.ply").write_ply(out + "/left.ply", applying.with_sliders(ob))
evaluated = bpy.context.evaluated_depsgraph_get()
set_all({"Crop Min": [-0.2, -0.2, -0.2], "Crop Max": [0.2, 0.2, 0.2]})
bpy.ops.timesplat.delete(what="INSIDE")
told["inside"] = left()
tell(**told)
"""


def test_deleted_gaussians_are_gone_and_the_rest_is_as_it_was(start, tmp_path):
    asset, told = start(DELETE, make(600))
    before, after = told["before"], told["after"]
    assert before == after and before["twin"] and before["note"] == "kept"
    assert told["done"] == ["FINISHED"] and told["again"] == ["CANCELLED"] and "no Gaussian" in told["all"]
    inside = ((asset.xyz >= np.float32([-0.7] * 3)) & (asset.xyz <= np.float32([0.5, 0.6, 0.7]))).all(1)
    times = np.linspace(-1, 1, 20001)
    fade = [np.exp(-0.5 * ((times - t) / s) ** 2).max() for t, s in zip(asset.t, asset.sigma_t, strict=True)]
    visible = inside & (asset.opacity * fade >= 0.3)
    small = visible & (asset.scale.max(1) <= 0.07)
    assert 600 > inside.sum() > visible.sum() > small.sum() > 50
    for got, mask in zip(told["left"], (inside, visible, small), strict=True):
        assert got == np.flatnonzero(mask).tolist()
    got = load(tmp_path / "left.npz")
    for key in ARRAYS:
        np.testing.assert_allclose(got[key], getattr(asset, key)[small], atol=1e-6 if key == "rgb" else 0)
    np.testing.assert_allclose(read_ply(tmp_path / "left.ply").xyz, asset.xyz[small])
    middle = (np.abs(asset.xyz) <= np.float32(0.2)).all(1)
    assert told["inside"] == np.flatnonzero(small & ~middle).tolist() and (small & middle).any()


RECTANGLE = """
camera = bpy.data.objects.new("eye", bpy.data.cameras.new("eye"))
scene.collection.objects.link(camera)
told = {"blind": refused(bpy.ops.timesplat.delete_rectangle, xmax=10, ymax=10)}
scene.camera, camera.location, camera.rotation_euler = camera, (1, -12, 3), (np.pi / 2, 0, 0)
camera.data.angle = np.radians(50)
scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 400, 200, 50
ob.data.attributes.new("mine", "INT", "POINT").data.foreach_set("value", np.arange(len(asset), dtype=np.int32))
scene.frame_set(20, subframe=0.5)
told["done"] = list(bpy.ops.timesplat.delete_rectangle(xmin=90, xmax=120, ymin=30, ymax=55))
ids = np.empty(len(ob.data.attributes["mine"].data), np.int32)
ob.data.attributes["mine"].data.foreach_get("value", ids)
tell(**told, left=ids.tolist())
"""


def test_a_rectangle_takes_what_is_visible_in_it(start):
    asset, told = start(RECTANGLE, make(600))
    position, opacity = asset.at(asset.frame_to_time(20.5))
    world = position * 2.5 + [1, -2, 3]
    depth = world[:, 1] + 12  # the camera looks along +y
    focal = 100 / np.tan(np.radians(25))  # of 200 x 100 pixels
    x, y = (world[:, 0] - 1) / depth * focal + 100, (world[:, 2] - 3) / depth * focal + 50
    taken = (x >= 90) & (x <= 120) & (y >= 30) & (y <= 55) & (opacity >= 0.05)
    assert 5 < taken.sum() < 200 and told["done"] == ["FINISHED"] and "no camera" in told["blind"]
    assert told["left"] == np.flatnonzero(~taken).tolist()


EDIT_MODE = """
told = {"has": "delete" in dir(bpy.ops.pointcloud) and display.has_point_clouds()}
if told["has"]:
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.pointcloud.select_all(action="DESELECT")
    chosen = ob.data.attributes.get(".selection") or ob.data.attributes.new(".selection", "BOOLEAN", "POINT")
    chosen.data.foreach_set("value", np.arange(len(asset)) % 3 == 0)
    bpy.ops.pointcloud.delete()
    told["poll"] = bpy.ops.timesplat.delete.poll()
    bpy.ops.object.mode_set(mode="OBJECT")
    save(holding.asset_of(ob), sys.argv[2] + "/left.npz")
    part("model.io.ply").write_ply(sys.argv[2] + "/left.ply", applying.with_sliders(ob))
tell(**told)
"""


def test_deleting_in_edit_mode_is_seen_too(start, tmp_path):
    asset, told = start(EDIT_MODE, make(300))
    if not told["has"]:
        pytest.skip("this Blender has no Edit Mode of point clouds")
    left = np.arange(300) % 3 != 0
    got = load(tmp_path / "left.npz")
    for key in ARRAYS:
        np.testing.assert_allclose(got[key], getattr(asset, key)[left], atol=1e-6 if key == "rgb" else 0)
    assert not told["poll"] and len(read_ply(tmp_path / "left.ply")) == 200


BAKE = """
told = {}
parent = bpy.data.objects.new("parent", None)
scene.collection.objects.link(parent)
parent.location = (5, 0, 0)
ob.parent = parent
ob["timesplat_source"] = ["original"]
scene.frame_start, scene.frame_end = 12, 18
set_all({"Time Scale": 0.5, "Density": 0.7, "Point Size": 2.0, "Look": "Points"})
told["done"] = list(bpy.ops.timesplat.bake())
new = bpy.context.object
bpy.context.view_layer.update()
told["same"] = (np.array(new.matrix_world) - np.array(ob.matrix_world)).tolist()
told["name"], told["hidden"] = new.name, [ob.hide_get(), ob.hide_render, new.hide_get(), new.hide_render]
told["sliders"] = {n: sliders.get_input(sliders.asset_modifier(new), n) for n in sliders.SLIDERS}
told["clip"] = save(holding.asset_of(new), sys.argv[2] + "/new.npz")
told["source"] = list(new["timesplat_source"])
told["order"] = attributes.read_attribute(ob.data, "gs_order").tolist()
bpy.context.view_layer.objects.active = ob
told["empty"] = refused(bpy.ops.timesplat.bake, frame_start=5, frame_end=4)
bpy.ops.timesplat.bake(frame_start=100, frame_end=120)
told["after"] = save(holding.asset_of(bpy.context.object), sys.argv[2] + "/after.npz")
ob.keyframe_insert("location", frame=1)
ob.location.x += 1
ob.keyframe_insert("location", frame=30)
bpy.context.view_layer.objects.active = ob
bpy.ops.timesplat.bake(frame_start=12, frame_end=14)
moving = bpy.context.object
scene.frame_set(25)
told["moving"] = (np.array(moving.matrix_world) - np.array(ob.matrix_world)).tolist()
tell(**told)
"""


def test_a_bake_is_shorter_and_shows_the_same(start, tmp_path):
    asset, told = start(BAKE, make(500))
    assert told["done"] == ["FINISHED"] and told["name"] == "a baked" and told["hidden"] == [True, True, False, False]
    assert np.abs(told["same"]).max() < 1e-6 and np.abs(told["moving"]).max() < 1e-6
    assert "empty" in told["empty"] and told["source"] == ["original"]
    s = told["sliders"]
    assert (s["Frame Start"], s["Frame End"], s["Time Scale"], s["Density"]) == (12, 18, 1, 1)
    assert s["Point Size"] == 2 and s["Look"] == "Points" and told["clip"][1:3] == [12, 18]
    chosen = np.array(told["order"], np.float32) < np.float32(0.7)
    sliders = s | {"Time Scale": 0.5, "Frame Start": 10, "Frame End": 33}
    new = replace(asset, **load(tmp_path / "new.npz"), clip=replace(asset.clip, frame_start=12, frame_end=18))
    ever = np.zeros(500, bool)
    for frame in np.linspace(12, 18, 1201):
        ever |= asset.at(expected_time(sliders, frame))[1] >= 0.05
    assert abs(len(new) - (ever & chosen).sum()) <= 1 < 500 - ever.sum()
    for frame in (12, 14.5, 18):
        position, opacity = asset.at(expected_time(sliders, frame))
        seen = chosen & (opacity >= 0.0501)
        got, alpha = new.at(new.frame_to_time(frame))
        np.testing.assert_allclose(got[alpha >= 0.0501], position[seen], atol=1e-5)
    # beyond the clip's end its last moment stands still
    after = load(tmp_path / "after.npz")
    position, opacity = asset.at(1.0)
    seen = chosen & (opacity >= 0.05)
    assert told["after"][1:3] == [100, 100]
    np.testing.assert_allclose(after["xyz"], position[seen], atol=1e-5)
    np.testing.assert_allclose(after["opacity"], opacity[seen], atol=1e-5)
    assert not after["velocity"].any() and not after["t"].any()
