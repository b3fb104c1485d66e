# SPDX-License-Identifier: GPL-3.0-or-later
"""Assets whose Gaussians ride on paths: nodes and edits against numpy. They go to Blender and back as pickles."""

import json
import pickle
import textwrap

import numpy as np
import pytest

from timesplat.model.io.asset import ARRAYS, STATIC_SIGMA_T, Asset, rotation_matrices
from timesplat.model.io.files import read_asset

from ..helpers import make_tracked
from .evaluated import READ, expected_time
from .test_display import FRAMES, RETIMED

START = """
import pickle
display, sliders, edit, holding, applying, tracks = (
    part(f"addon.asset.{x}") for x in ("display", "sliders", "edit", "asset_object", "apply_sliders", "tracks"))
bpy.ops.wm.read_factory_settings(use_empty=True)
with open(sys.argv[1] + "/a.pickle", "rb") as f:
    asset = pickle.load(f)
scene, told = bpy.context.scene, {}
ob = display.add_asset(asset, "a", look="Points")
start = {name: sliders.get_input(sliders.asset_modifier(ob), name) for name in sliders.SLIDERS}
def set_all(ob, values):
    for name, value in values.items():
        if sliders.input_property(sliders.asset_modifier(ob), name):
            sliders.set_input(sliders.asset_modifier(ob), name, value)
def save(asset, name):
    with open(f"{sys.argv[1]}/{name}.pickle", "wb") as f:
        pickle.dump(asset, f, 4)  # numpy 1.26 cannot read what numpy 2 pickles by a later protocol
def at(frame, ob, *names):
    scene.frame_set(int(frame // 1), subframe=frame % 1)
    return shown(ob, "position", "gs_alpha", *names)
def refused(call, *args, **options):
    try:
        call(*args, **options)
    except (RuntimeError, part("datagen.sequence").InputError) as e:
        return str(e).strip().splitlines()[-1]
"""


@pytest.fixture
def start(blender, tmp_path):
    """start(code, asset, *args) -> what `tell` was given."""

    def run(code, asset, *args):
        with open(tmp_path / "a.pickle", "wb") as f:
            pickle.dump(asset, f)
        return blender(READ + START + textwrap.dedent(code), tmp_path, *args)

    return run


def load(path) -> Asset:
    with open(path, "rb") as f:
        return pickle.load(f)


def assert_shown(got: dict, asset: Asset, time: float, cut=0.05, chosen=True, atol=1e-5) -> np.ndarray:
    """Returns which Gaussians are to be seen."""
    position, opacity = asset.at(time)
    seen = chosen & (opacity >= cut) & asset.paths.there(time)[asset.path]
    assert seen.any()
    np.testing.assert_allclose(got["position"], position[seen], atol=atol)
    np.testing.assert_allclose(got["gs_alpha"], opacity[seen], atol=atol)
    return seen


def test_evaluated_attributes_are_those_of_numpy(start):
    code = """
    for look in ("Points", "Splats"):
        sliders.set_input(sliders.asset_modifier(ob), "Look", look)
        for frame in (10.0, 16.25, 21.0, 21.5, 32.9, 33.0, 40.5):
            told[f"{look} {frame}"] = at(frame, ob, "radius", "gs_row_0", "gs_row_1", "gs_row_2")
    tell(**told)
    """
    asset = make_tracked()
    few = set()
    for key, got in start(code, asset).items():
        look, frame = key.split()
        time = min(asset.frame_to_time(float(frame)), 1)
        seen = assert_shown(got, asset, time)
        few.add(seen.sum())
        soft = np.sort(asset.soft_scale()[seen], 1)
        np.testing.assert_allclose(got["radius"], 1.5 * soft[:, 1] if look == "Points" else 3 * soft[:, 2], rtol=1e-5)
        if look == "Splats":
            R = rotation_matrices(asset.rotation_at(time)[seen])
            rows = (R / asset.soft_scale()[seen, None]).transpose(0, 2, 1)
            for i in range(3):
                np.testing.assert_allclose(got[f"gs_row_{i}"], rows[:, i], atol=1e-5 * np.abs(rows).max())
    assert len(few) > 3 and max(few) < len(asset), "windows make a difference"


OPTIONS = [
    *RETIMED,
    {"Density": 0.3},
    {"Opacity Cut": 0.0},
    {"Opacity Cut": 0.5, "Lifetime Scale": 0.01},
    {"Crop": True, "Crop Min": [-0.5, -0.2, -1.0], "Crop Max": [0.4, 0.9, 0.3], "Time Scale": 0.5},
]


def test_every_slider_does_what_numpy_says(start):
    code = """
    for case in json.loads(sys.argv[2]):
        set_all(ob, {**start, **case["set"]})
        told.setdefault("got", []).append(at(case["frame"], ob))
        position, seen = applying.shown_gaussians(ob, case["frame"])
        told.setdefault("numpy", []).append(position[seen].tolist())
    tell(**told, start=start, order=part("addon.asset.attributes").read_attribute(ob.data, "gs_order").tolist(),
         has=bool(sliders.input_property(sliders.asset_modifier(ob), "Lifetime Scale")))
    """
    asset = make_tracked()
    cases = [{"set": c, "frame": f} for c in OPTIONS for f in FRAMES]
    told = start(code, asset, json.dumps(cases))
    assert not told["has"], "there is no lifetime to scale"
    for case, got, ours in zip(cases, told["got"], told["numpy"], strict=True):
        s = told["start"] | case["set"]
        inside = ((asset.xyz >= s["Crop Min"]) & (asset.xyz <= s["Crop Max"])).all(1)
        chosen = (np.array(told["order"]) < s["Density"]) & (inside | (not s["Crop"]))
        assert_shown(got, asset, expected_time(s, case["frame"]), s["Opacity Cut"], chosen, atol=3e-5)
        np.testing.assert_allclose(ours, got["position"], atol=3e-5, err_msg=str(case))


def test_an_object_gives_the_asset_back_and_what_is_left_of_it(start, tmp_path):
    code = """
    save(holding.asset_of(ob), "first")
    edit.keep_gaussians(ob, (asset.path % 3 == 1) & (np.arange(len(asset)) % 2 == 0))
    save(holding.asset_of(ob), "left")
    told["left"] = at(21.5, ob)
    modifier = sliders.asset_modifier(ob)
    knots = bpy.data.objects["a Paths"]
    sliders.set_input(modifier, "Paths", None)
    told["none"] = refused(holding.asset_of, ob)
    sliders.set_input(modifier, "Paths", knots)
    knots.data.clear_geometry()
    told["empty"] = refused(holding.asset_of, ob)
    tracks.MAX_KNOTS = 10
    told["many"] = refused(display.add_asset, asset, "b")
    tell(**told, objects=[o.name for o in bpy.data.objects])
    """
    asset = make_tracked(500)
    told = start(code, asset)
    first, left = load(tmp_path / "first.pickle"), load(tmp_path / "left.pickle")
    for name in ARRAYS:
        got, want = getattr(first, name), getattr(asset, name)
        assert np.allclose(got, want, atol=1e-6) if name == "rgb" else np.array_equal(got, want), name
    assert first.clip == asset.clip and first.path.dtype == np.int32 and np.array_equal(first.path, asset.path)
    for name, want in vars(asset.paths).items():
        got = getattr(first.paths, name)
        assert got.dtype == want.dtype and np.array_equal(got, want), name
    want = asset[(asset.path % 3 == 1) & (np.arange(500) % 2 == 0)]
    assert len(left.paths) == len(want.paths) < 20 and np.array_equal(left.path, want.path)
    assert np.array_equal(left.paths.place, want.paths.place) and np.array_equal(left.xyz, want.xyz)
    assert_shown(told["left"], want, want.frame_to_time(21.5))
    assert "import it again" in told["none"] and "import it again" in told["empty"] and "10" not in told["many"]
    assert "too many" in told["many"] and told["objects"] == ["a", "a Paths", "Timesplat Ellipsoid"]


CASES = [
    ({"Time Scale": 2.0}, (12, 18)),
    ({"Time Scale": -0.5, "Time Offset": 30.0}, (12, 30)),
    ({"Time Offset": 2.0, "Density": 0.5}, (13, 20)),
    ({"Crop": True, "Crop Min": [-0.5, -0.4, -1.0], "Crop Max": [0.7, 0.9, 0.3]}, (15, 16)),
]


def test_a_bake_and_a_moment_show_the_same(start, tmp_path):
    code = """
    for i, (case, (first, last)) in enumerate(json.loads(sys.argv[2])):
        set_all(ob, {**start, **case})
        bpy.context.view_layer.objects.active = ob
        new = edit.bake(ob, (first, last))
        save(holding.asset_of(new), f"baked{i}")
        ob.hide_set(False)
        middle = (first + last) / 2 + 0.25
        told[i] = [[at(frame, each) for each in (ob, new)] for frame in (first, middle, last)]
        scene.frame_set(last)
        save(applying.moment(ob, holding.asset_of(ob), scene.frame_current_final), f"moment{i}")
        save(applying.with_sliders(ob, (last, last)), f"frozen{i}")
    tell(**{str(k): v for k, v in told.items()}, start=start, paths=sum(" Paths" in o.name for o in bpy.data.objects),
         order=part("addon.asset.attributes").read_attribute(ob.data, "gs_order").tolist())
    """
    asset = make_tracked(400)
    told = start(code, asset, json.dumps(CASES))
    assert told["paths"] == 1 + len(CASES)
    for i, (case, (first, last)) in enumerate(CASES):
        s = told["start"] | case
        inside = ((asset.xyz >= s["Crop Min"]) & (asset.xyz <= s["Crop Max"])).all(1)
        chosen = (np.array(told["order"]) < s["Density"]) & (inside | (not s["Crop"]))
        baked = load(tmp_path / f"baked{i}.pickle")
        assert (baked.clip.frame_start, baked.clip.frame_end) == (first, last)
        assert (baked.sigma_t == STATIC_SIGMA_T).all()
        assert len(baked) < len(asset), "what is never there is left out"
        for frame, (old, new) in zip((first, (first + last) / 2 + 0.25, last), told[str(i)], strict=True):
            seen = assert_shown(old, asset, expected_time(s, frame), chosen=chosen, atol=3e-5)
            assert_shown(new, baked, baked.frame_to_time(frame), atol=3e-5)
            np.testing.assert_allclose(new["position"], old["position"], atol=5e-5)
        turned = rotation_matrices(asset.rotation_at(expected_time(s, last))[seen])
        still = baked.at(1.0)[1] >= 0.05
        np.testing.assert_allclose(rotation_matrices(baked.rotation_at(1.0)[still]), turned, atol=1e-4)
        for name in ("moment", "frozen"):
            now = load(tmp_path / f"{name}{i}.pickle")
            assert now.paths is None and now.path is None and not now.velocity.any()
            if name == "frozen":  # what is away then has no opacity
                now = now[now.opacity >= 0.05]
            np.testing.assert_allclose(now.xyz, old["position"], atol=3e-5)
            np.testing.assert_allclose(rotation_matrices(now.rotation), turned, atol=1e-4)


PASSED_ON = """
names = lambda: sorted(o.name for o in bpy.data.objects)
there = lambda ob: at(21.5, ob)["position"]
told["fresh"] = there(ob)
told["in scenes"] = [o.name for o in bpy.data.objects if o.users_collection]
bpy.ops.object.duplicate()
twin = bpy.context.object
told["twin"], told["names"] = there(twin), names()
bpy.data.objects.remove(twin)
bpy.ops.outliner.orphans_purge(do_recursive=True)
other = bpy.data.scenes.new("other")
other.collection.objects.link(ob)
scene.collection.objects.unlink(ob)
bpy.context.window.scene = scene = other
told["other scene"] = there(ob)
bpy.ops.wm.save_as_mainfile(filepath=sys.argv[1] + "/a.blend")
tell(**told)
"""
TAKEN = """
path, out = sys.argv[1] + "/a.blend", {}
def there(ob):
    bpy.context.scene.frame_set(21, subframe=0.5)
    return shown(ob, "position")["position"]
bpy.ops.wm.open_mainfile(filepath=path)
out["opened"] = there(bpy.data.objects["a"])
for way in ("append", "link"):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    getattr(bpy.ops.wm, way)(filepath=path + "/Object/a", directory=path + "/Object/", filename="a")
    out[way] = there(bpy.data.objects["a"])
    out[way + " shows"] = [o.name for o in bpy.context.scene.objects if not o.hide_render]
tell(ours=[m for m in sys.modules if m.startswith("timesplat.")], **out)
"""


def test_it_plays_on_in_other_files_and_scenes(blender, start, tmp_path):
    """And without the add-on, of which the second Blender knows nothing."""
    asset = make_tracked()
    told = start(PASSED_ON, asset)
    assert told["in scenes"] == ["a"] and told["names"] == ["Timesplat Ellipsoid", "a", "a Paths", "a.001"]
    taken = blender(READ + TAKEN, tmp_path)
    assert taken["ours"] == [] and taken["append shows"] == taken["link shows"] == ["a"]
    position, opacity = asset.at(asset.frame_to_time(21.5))
    ways = [told[k] for k in ("fresh", "twin", "other scene")] + [taken[k] for k in ("opened", "append", "link")]
    for way in ways:
        np.testing.assert_allclose(way, position[opacity >= 0.05], atol=1e-5)


NATIVE = """
nodes, node_trees = part("addon.asset.nodes"), part("addon.asset.node_trees")
part("addon.asset.attributes").write_attributes(ob.data, [("rotation", "QUATERNION", asset.on_path()[1])])
tree = sliders.asset_modifier(ob).node_group = sliders.asset_modifier(ob).node_group.copy()
n = node_trees.Nodes(tree)
placed, end = (next(x for x in tree.nodes if x.bl_idname == k) for k in ("GeometryNodeSetPosition", "NodeGroupOutput"))
n.put(end.inputs[0], nodes._turn(n, placed.outputs[0], "rotation", "QUATERNION"))
tell(**at(20.5, ob, "rotation"))
"""


def test_blenders_own_splats_turn_with_their_path(start):
    asset = make_tracked()
    got, time = start(NATIVE, asset), asset.frame_to_time(20.5)
    seen = assert_shown(got, asset, time)
    want = rotation_matrices(asset.rotation_at(time)[seen])
    np.testing.assert_allclose(rotation_matrices(np.array(got["rotation"])), want, atol=1e-5)


RENDER = """
from pathlib import Path
borrow, render_setup = part("datagen.scene.borrow"), part("datagen.render_setup")
read_multilayer = part("datagen.blender_output").read_multilayer
eye = bpy.data.objects.new("eye", bpy.data.cameras.new("eye"))
scene.collection.objects.link(eye)
eye.location, eye.rotation_euler = (1, -8, 3), (np.pi / 2, 0, 0)
scene.camera = eye
scene.frame_set(21, subframe=0.5)
still = display.add_asset(applying.moment(ob, holding.asset_of(ob), 21.5), "still")
pictures = []
for each in (ob, still):
    sliders.set_input(sliders.asset_modifier(each), "Look", "Splats")
    with borrow.borrowed([each]) as stage:
        render_setup.apply_settings(stage, render_setup.CaptureSettings((48, 48), 4, passes=False))
        stage.camera = eye
        stage.frame_set(21, subframe=0.5)
        stage.render.filepath = sys.argv[1] + "/frame"
        with bpy.context.temp_override(scene=stage):
            bpy.ops.render.render(write_still=True)
    pictures.append(np.array(read_multilayer(Path(sys.argv[1], "frame.exr"))["combined"]))
tell(off=np.abs(pictures[0] - pictures[1]).mean().item(), spread=pictures[1].std().item())
"""


def test_a_render_shows_the_moment(start):
    """As a comparison renders it: in a scene of its own; the same as what does not move."""
    told = start(RENDER, make_tracked(200))
    assert told["spread"] > 0.02 and told["off"] < 1e-3 * told["spread"], told


OPERATORS = """
part("addon").register()
scene.frame_set(21, subframe=0.5)
camera = bpy.data.objects.new("eye", bpy.data.cameras.new("eye"))
scene.collection.objects.link(camera)
camera.location, camera.rotation_euler = (1, -12, 3), (np.pi / 2, 0, 0)
scene.camera = camera
scene.render.resolution_x = scene.render.resolution_y = 100
before = len(at(21.5, ob)["position"])
told["done"] = [list(bpy.ops.timesplat.delete_rectangle(xmin=40, xmax=60, ymin=0, ymax=100))]
told["gone"] = before - len(at(21.5, ob)["position"]), len(asset) - len(ob.data.attributes["gs_t"].data)
told["done"].append(list(bpy.ops.timesplat.delete(what="FAINT", opacity=0.3)))
scene.frame_start, scene.frame_end = 14, 16
told["done"].append(list(bpy.ops.timesplat.export_asset(filepath=sys.argv[1] + "/frames", format="SLICES")))
told["shown"] = [at(f, ob)["world"] for f in (14, 15, 16)]
told["done"].append(list(bpy.ops.timesplat.bake()))
told["baked"] = at(15, bpy.context.object)["world"]
part("addon").unregister()
tell(**told)
"""


def test_operators_take_it_like_any_other(start, tmp_path):
    told = start(OPERATORS, make_tracked())
    assert told["done"] == [["FINISHED"]] * 4
    assert 0 < told["gone"][0] == told["gone"][1] < 300, "what is not there at the moment stays"
    for frame, world in zip((14, 15, 16), told["shown"], strict=True):
        x, y, z = read_asset(tmp_path / f"frames/frames_{frame:04d}.ply").asset.xyz[:5].T
        np.testing.assert_allclose(np.stack([x, z, -y], 1), world, atol=1e-4)
    np.testing.assert_allclose(told["baked"], told["shown"][1], atol=1e-4)
