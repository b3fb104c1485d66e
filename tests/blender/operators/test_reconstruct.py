# SPDX-License-Identifier: GPL-3.0-or-later
"""Reconstruct: what is captured, in background from end to end, and what can go wrong on the way."""

import numpy as np
import pytest

from timesplat.model.io.ply import read_ply

ANIMATE = """
import time
for o in list(bpy.data.objects):
    bpy.data.objects.remove(o)
for c in list(bpy.data.cameras):
    bpy.data.cameras.remove(c)
scene = bpy.context.scene
scene.frame_start, scene.frame_end, scene.render.fps = 5, 19, 30
bpy.ops.mesh.primitive_uv_sphere_add(radius=0.5)
ball = bpy.context.object
for frame, x in ((5, 1.0), (19, 3.0)):
    ball.location = (x, 2, 3)
    ball.keyframe_insert("location", frame=frame)
for i in ball.animation_data.action.fcurves if hasattr(ball.animation_data.action, "fcurves") else \
        ball.animation_data.action.layers[0].strips[0].channelbags[0].fcurves:
    for k in i.keyframe_points:
        k.interpolation = "LINEAR"
scene.frame_set(9)
runs = bpy.utils.extension_path_user(name, path="runs", create=True)
QUICK = dict(method="lift", budget="ALL", refine=0, samples=2)
def seen(ob):  # where a mesh stands in (4.2, 4.3), the points are an instance of it
    depsgraph = bpy.context.evaluated_depsgraph_get()
    for i in depsgraph.object_instances:
        of = i.parent if i.is_instance else i.object
        if i.object.type == "POINTCLOUD" and of.original == ob:
            return [list(i.matrix_world @ p.co) for p in i.object.data.points]
"""
RECONSTRUCT = """
scene.render.resolution_x, scene.cycles.samples = 333, 77
ball.rotation_euler.x = 0.5  # changed and not keyed
before = [len(bpy.data.objects), len(bpy.data.scenes), len(bpy.data.cameras), len(bpy.data.worlds)]
done = bpy.ops.timesplat.reconstruct(method="lift", every=2, size=48, samples=4, output=sys.argv[1], budget="ALL",
                                     refine=0, look="Points")
ob = bpy.context.object
alone = [ball.hide_get(), ball.hide_render, part("addon.asset.visibility").shown(ob, bpy.context)]
ball.hide_set(False)  # what is hidden is not evaluated; renders do not show it still
same = [scene.frame_current == 9, scene.render.resolution_x == 333, scene.cycles.samples == 77,
        abs(ball.rotation_euler.x - 0.5) < 1e-6, bpy.data.filepath == ""]
result = {}
for frame in (5, 12.5, 19):
    scene.frame_set(int(frame), subframe=frame % 1)
    points = np.array(seen(ob))
    radius = np.linalg.norm(points - np.array(ball.matrix_world.translation), axis=1)
    result[frame] = [points.mean(0).tolist(), float(np.median(radius))]
after = [len(bpy.data.objects), len(bpy.data.scenes), len(bpy.data.cameras), len(bpy.data.worlds)]
camera = bpy.data.objects.new("Eye", bpy.data.cameras.new("Eye"))
scene.collection.objects.link(camera)
camera.location, camera.rotation_euler = (2, -1, 3), (np.pi / 2, 0, 0)
bpy.ops.object.select_all(action="DESELECT")
camera.select_set(True)
second = bpy.ops.timesplat.reconstruct(method="deform", every=5, size=32, samples=2, budget="NUMBER", number=50,
                                       refine=0.5)
count = len(bpy.context.object.data.points if hasattr(bpy.context.object.data, "points") else
            bpy.context.object.data.vertices)
tell(done=list(done), second=list(second), frames=result, before=before, after=after, left=os.listdir(runs),
     same=same, alone=alone, torch="torch" in sys.modules, source=list(ob["timesplat_source"]), count=count)
"""


def test_a_ball_on_a_line(installed, tmp_path):
    """Captured, lifted in a worker and back over the original; nothing else of the scene has changed."""
    pytest.importorskip("torch")
    told = installed(ANIMATE + RECONSTRUCT, tmp_path / "kept.ply")
    assert told["done"] == told["second"] == ["FINISHED"] and not told["torch"]
    for frame, x in (("5", 1), ("12.5", 15 / 7), ("19", 3)):
        mean, radius = told["frames"][frame]
        np.testing.assert_allclose(mean, [x, 2, 3], atol=0.25)
        assert abs(radius - 0.5) < 0.12  # eight pictures of 48 pixels
    objects, *others = told["before"]
    assert told["alone"] == [True, True, "RESULT"]
    assert told["after"] == [objects + 2, *others] and told["left"] == [] and all(told["same"]), told
    assert told["source"] == ["Sphere"] and 1 <= told["count"] <= 50
    kept = read_ply(tmp_path / "kept.ply")
    assert (kept.clip.frame_start, kept.clip.frame_end, kept.clip.fps) == (5, 19, 30)
    assert abs(kept.clip.scale - 1.5) < 0.01


TRACKED = """
ball.shape_key_add(name="Basis")
tall = ball.shape_key_add(name="Tall")
for point in tall.data:
    point.co.z *= 1.8
for frame, value in ((5, 0.0), (19, 1.0)):
    tall.value = value
    tall.keyframe_insert("value", frame=frame)
image = bpy.data.images.new("halves", 2, 1)
image.pixels = [0.9, 0.05, 0.05, 1, 0.05, 0.05, 0.9, 1]
image.pack()
material = bpy.data.materials.new("halves")
if bpy.app.version < (5, 0):
    material.use_nodes = True
nodes, links = material.node_tree.nodes, material.node_tree.links
texture = nodes.new("ShaderNodeTexImage")
texture.image, texture.interpolation = image, "Closest"
links.new(texture.outputs["Color"], next(n for n in nodes if n.type == "BSDF_PRINCIPLED").inputs["Base Color"])
ball.data.materials.append(material)

options = dict(method="tracks", samples=4, budget="ALL", look="Points")
bpy.ops.timesplat.reconstruct(every=2, size=48, refine=0.5, output=sys.argv[1], **options)
ob = bpy.context.object
ball.hide_set(False)
off = {}
for frame in (5, 12.5, 19):
    scene.frame_set(int(frame), subframe=frame % 1)
    there = ball.evaluated_get(bpy.context.evaluated_depsgraph_get())
    to_ball = there.matrix_world.inverted()
    found = [(to_ball @ part("addon.operators.reconstruct").Matrix.Translation(p).translation) for p in seen(ob)]
    off[frame] = [(there.closest_point_on_mesh(p)[1] - p).length for p in found]
    off[f"{frame} height"] = max(p.z for p in found)
messages = [part("addon.runtime.jobs").JOBS[-1].message]
ob.hide_render = True
bpy.ops.object.metaball_add(location=(2, 4, 3))
growing = bpy.context.object.data.elements[0]
for frame, radius in ((5, 0.5), (19, 1.0)):
    growing.radius = radius
    growing.keyframe_insert("radius", frame=frame)
bpy.ops.timesplat.reconstruct(every=7, size=32, refine=0, **options)
messages.append(part("addon.runtime.jobs").JOBS[-1].message)
tell(off=off, messages=messages, tracked=part("addon.asset.tracks").is_tracked(ob))
"""


def test_a_textured_surface_that_changes_its_shape_is_followed(installed, tmp_path):
    """By method tracks: the points lie over the original whatever its shape is, in its texture's colours; what could
    not be followed beside it is said at the end."""
    pytest.importorskip("torch")
    told = installed(ANIMATE + TRACKED, tmp_path / "kept.ply")
    assert told["tracked"]
    for frame, height in (("5", 0.5), ("12.5", 0.7), ("19", 0.9)):
        assert np.median(told["off"][frame]) < 0.08 and np.quantile(told["off"][frame], 0.95) < 0.15
        assert abs(told["off"][f"{frame} height"] - height) < 0.1
    kept = read_ply(tmp_path / "kept.ply")
    assert kept.paths is not None and (kept.clip.frame_start, kept.clip.frame_end) == (5, 19)
    redder = kept.rgb[:, 0] - kept.rgb[:, 2]
    assert (abs(redder) > 0.2).mean() > 0.9 and 0.3 < (redder > 0).mean() < 0.7
    first, second = told["messages"]
    assert first.startswith(f"{len(kept):,} Gaussians in ") and first.endswith(" s")
    assert " s. Mball: the surface could not be followed, motion vectors lead it." in second


REFUSED = """
jobs = part("addon.runtime.jobs")
errors = {}
def refused(key, **options):
    try:
        bpy.ops.timesplat.reconstruct(size=32, every=8, **QUICK, **options)
        errors[key] = "accepted"
    except RuntimeError as e:
        errors[key] = str(e).strip()
bpy.ops.object.camera_add()
camera = bpy.context.object
camera.data.type = "ORTHO"
refused("ortho")
camera.data.type = "PERSP"
refused("nothing", source="SELECTED")
refused("collection", source="COLLECTION", collection="Cellar")
refused("range", frame_range="CUSTOM", frame_start=5, frame_end=2)
refused("folder", output="/nowhere/a.ply")
refused("suffix", output="/a.obj")
refused("checkpoint", checkpoint="/nowhere/a.safetensors")
camera.select_set(False)
ball.hide_render = True
refused("hidden")
ball.hide_render = False
part("addon.runtime.background_blender")._remember_texts()  # as after a file was opened
text = bpy.data.texts.new("guest")
text.use_module = True
refused("guest")
text.use_module = False
python, os.environ["TIMESPLAT_PYTHON"] = os.environ["TIMESPLAT_PYTHON"], "/nowhere/python"
refused("python")
os.environ["TIMESPLAT_PYTHON"] = "/bin/false"
refused("dies")
os.environ["TIMESPLAT_PYTHON"] = "/bin/sh"
open(sys.argv[1], "w").write("not weights")
told = dict(errors=errors, left=os.listdir(runs), states=[j.state for j in jobs.JOBS], frame=scene.frame_current,
            scenes=len(bpy.data.scenes), clouds=sum("timesplat" in o for o in bpy.data.objects))
os.environ["TIMESPLAT_PYTHON"] = python
text.use_module = True
bpy.ops.wm.save_as_mainfile(filepath=sys.argv[1] + ".blend")
bpy.ops.wm.open_mainfile(filepath=sys.argv[1] + ".blend", use_scripts=True)
tell(**told, host=list(bpy.ops.timesplat.reconstruct(size=32, every=8, **QUICK)))
"""
SAID = {
    "ortho": "perspective",
    "nothing": "nothing to capture",
    "collection": "no such collection",
    "range": "empty",
    "folder": "no such folder",
    "suffix": "must end in .ply",
    "checkpoint": "no such checkpoint",
    "guest": "guest: this text came after",
    "hidden": "no mesh is visible",
    "python": "no such file",
    "dies": "code 1",
}


def test_what_cannot_be_done_is_said(installed, tmp_path):
    told = installed(ANIMATE + REFUSED, tmp_path / "bad.safetensors")
    for key, word in SAID.items():
        said = told["errors"][key]
        assert word in said and "Traceback" not in said and "\n" not in said, (key, said)
    assert told["left"] == [] and told["scenes"] == 1 and told["clouds"] == 0 and told["frame"] == 9
    assert told["host"] == ["FINISHED"]  # it was there when the file was opened


MEANWHILE = """
part("addon").register()
reconstruct, model, jobs = part("addon.operators.reconstruct"), part("model.io.asset"), part("addon.runtime.jobs")
Vector = part("addon.operators.reconstruct").Matrix.Translation
begun, results = [], {}
jobs.start = lambda label, stages, finish, *rest, **named: begun.append(finish)
folder = reconstruct.Path(sys.argv[1])
clip = model.Clip(24, 1, 2, 1.0, (1.0, 2.0, 3.0))
rows = {"xyz": 3, "t": 0, "velocity": 3, "sigma_t": 0, "scale": 3, "rotation": 4, "rgb": 3, "opacity": 0}
parts = {k: np.full((2, n) if n else 2, 0.5, np.float32) for k, n in rows.items()}
part("model.io.ply").write_ply(folder / "asset.ply", model.Asset(**parts, clip=clip))

def when(name, before, meanwhile, after=lambda *_: None, **options):
    bpy.ops.wm.read_homefile(use_factory_startup=True)
    scene, box = bpy.context.scene, bpy.data.objects["Cube"]
    box.location = (1, 2, 3)
    before(box)
    for k, v in options.items():
        setattr(scene.timesplat, k, v)
    scene.timesplat.method = "lift"
    bpy.context.view_layer.update()
    reconstruct.start(scene.timesplat, bpy.context)
    meanwhile(box)
    begun.pop()({}, folder)
    ob = bpy.context.object
    after(ob)
    bpy.context.view_layer.update()
    results[name] = [ob.parent.name if ob.parent else None, list(ob.matrix_world.translation),
                     sorted(ob["timesplat_source"])]

def other(box):
    ob = box.copy()
    ob.name = "Other"
    bpy.context.scene.collection.objects.link(ob)
    return ob

def rename(box):
    box.name = "New"
    other(box).name = "Cube"

def child(box):
    box.parent = bpy.data.objects.new("Root", None)
    bpy.context.scene.collection.objects.link(box.parent)
    bpy.ops.object.select_all(action="DESELECT")
    box.select_set(True)

def shift(*path):
    def do(ob):
        for p in path:
            ob = getattr(ob, p)
        ob.location.x += 5
    return do

nothing = lambda box: None
when("nothing", nothing, nothing)
when("moved after", nothing, nothing, shift("parent"))
when("moved meanwhile", nothing, shift())
when("renamed", nothing, rename)
when("deleted", other, lambda box: bpy.data.objects.remove(box))
when("the only one deleted", nothing, lambda box: bpy.data.objects.remove(box))
when("flat", lambda box: setattr(box, "scale", (1, 1, 0)), nothing)
when("hidden", lambda box: box.hide_set(True), nothing)
when("hidden and disabled", lambda box: setattr(box, "hide_viewport", True), nothing)
when("a selected child", child, nothing, shift("parent", "parent"), source="SELECTED")
when("keyed", lambda box: box.keyframe_insert("location", frame=1), nothing)
tell(results=results)
"""


def test_what_becomes_of_the_original_meanwhile(blender, tmp_path):
    here, beside = [1, 2, 3], [6, 2, 3]
    results = blender(MEANWHILE, tmp_path)["results"]
    for name, parent, place, source in (
        ("nothing", "Cube", here, ["Cube"]),
        ("moved after", "Cube", beside, ["Cube"]),
        ("moved meanwhile", "Cube", beside, ["Cube"]),
        ("renamed", "New", here, ["New"]),
        ("deleted", None, here, ["Other"]),
        ("the only one deleted", None, here, []),
        ("flat", None, here, ["Cube"]),
        ("hidden", "Cube", here, ["Cube"]),
        ("hidden and disabled", "Cube", here, ["Cube"]),
        ("a selected child", "Cube", beside, ["Cube"]),
        ("keyed", None, here, ["Cube"]),
    ):
        got = results[name]
        assert [got[0], got[2]] == [parent, source], (name, got)
        np.testing.assert_allclose(got[1], place, atol=1e-5, err_msg=name)
