# SPDX-License-Identifier: GPL-3.0-or-later
"""Untidy scenes: what an artist's file has in it must neither break the capture nor bend it.

One Blender builds all of them, one after another, and captures each as the add-on does, but for the process beside.
Depth, focal length and pose of every picture are turned back into world points: these must be where the box is. The
flow must lead from them to where it is a frame later.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from timesplat.datagen.sequence import read_sequence

from ..helpers import CHECKOUT, Runner

SETUP = """
import traceback
part("addon").register()
settings, reconstruct = part("addon.settings"), part("addon.operators.reconstruct")
capturing = part("addon.runtime.capture")
InputError, rigs = capturing.InputError, capturing.rigs
rigs.RIGS["far"] = lambda frames, seed: [rigs.Shot(f, n, "far", rigs.spherical(a, 0, 4)) for f in frames
                                         for n, a in rigs.CANONICAL.items()]
FACES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]

def box(name="Box", location=(0, 0, 0), size=2, parent=None, to=None):
    data, s = bpy.data.meshes.new(name), (-size / 2, size / 2)
    data.from_pydata([(x, y, z) for x in s for y in s for z in s], [], FACES)
    return add(name, data, location, parent, to)

def add(name, data, location=(0, 0, 0), parent=None, to=None):
    ob = bpy.data.objects.new(name, data)
    (to or bpy.context.scene.collection).objects.link(ob)
    ob.location, ob.parent = location, parent
    bpy.context.view_layer.update()
    return ob

def eye(name="Eye", location=(0, -9, 0), turn=(np.pi / 2, 0, 0), select=True, parent=None):
    ob = add(name, bpy.data.cameras.new(name), location, parent)
    ob.rotation_euler = turn
    ob.select_set(select)
    return ob

def key(owner, path, values):
    for frame, value in values.items():
        setattr(owner, path, value)
        owner.keyframe_insert(path, frame=frame)

def driver(owner, path, index, expression, **of):
    d = owner.driver_add(path, index).driver
    d.expression = expression
    for name, data_path in of.items():
        v = d.variables.new()
        v.name, v.targets[0].id_type = name, "SCENE"
        v.targets[0].id, v.targets[0].data_path = bpy.context.scene, data_path

def collection(name):
    c = bpy.data.collections.new(name)
    bpy.context.scene.collection.children.link(c)
    return c, bpy.context.view_layer.layer_collection.children[name]

def libraries(make):  # what make(i) gives, linked from two libraries in which it has the same name
    found = []
    for i in range(2):
        path = os.path.join(sys.argv[1], f"library{i}.blend")
        ob = make(i)
        ob.name = "Same"
        bpy.context.view_layer.update()
        bpy.data.libraries.write(path, {ob})
        bpy.data.objects.remove(ob)
        with bpy.data.libraries.load(path, link=True) as (_, wanted):
            wanted.objects = ["Same"]
        bpy.context.scene.collection.objects.link(wanted.objects[0])
        found.append(wanted.objects[0])
    bpy.context.view_layer.update()
    return found

def steps(first, last, every=1, **more):
    return dict(frame_range="CUSTOM", frame_start=first, frame_end=last, every=every, **more)

told = {}
def case(name, make):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = 1, 2
    if scene.render.engine != "CYCLES":
        scene.render.engine = "CYCLES"
    try:
        options = dict(size=24, samples=1, method="lift") | (make(scene) or {})
        cameras = settings.cameras(bpy.context)[0]
        for k, v in options.items():
            setattr(scene.timesplat, k, v)
        request = json.loads(json.dumps(reconstruct.request(scene.timesplat, bpy.context)))
        request |= dict(name="x.blend", rig=None if cameras else "far", sequence=os.path.join(sys.argv[1], name))
        capturing._capture(request, lambda *_: None)
        told[name] = ""
    except InputError as e:
        told[name] = str(e)
    except Exception:
        told[name] = traceback.format_exc()
"""


@dataclass
class Scene:
    """boxes: where there is something at each frame, (2,3) low and high, or None; moves: by how much until the
    next frame; sides: how many sides of a box the cameras see whole; said: the sentence that refuses it."""

    code: str
    boxes: tuple
    moves: tuple | None
    sides: int
    said: str


SCENES: dict[str, Scene] = {}


def scene(name, *boxes, code, moves=None, sides=3, said=""):
    SCENES[name] = Scene(code, boxes, moves, sides, said)


def at(x=0.0, y=0.0, z=0.0, half=1.0):
    middle = np.array([x, y, z])
    return middle - half, middle + half


def still(name, code, box=at(), **more):  # noqa: B008
    scene(name, box, box, code=code, **more)


# ---------------------------------------------------------------- what is seen

still("as it is", "box()")
still("far away and huge", "box(location=(1e5, 1e5, 0), size=2e4)", at(1e5, 1e5, 0, 1e4))
still("tiny", "box(size=2e-4)", at(half=1e-4))
still("negative scale", "box().scale = (-1, 1, 1)")
still("flat", "box().scale = (1, 0, 1)", ([-1, 0, -1], [1, 0, 1]))
still("units and names", "scene.unit_settings.scale_length = 0.01; box('Ключ \"q\"\\n' + 'я' * 25)")
still("disabled in the viewport", "box().hide_viewport = True; box('dot', size=1)")
still("hidden by hand", "box().hide_set(True); box('dot', size=1)")
still("invisible to cameras", "box(); box('blocker', (0, 0, 40)).visible_camera = False")
still("a shadow catcher", "box(); box('floor', (0, 0, -21), 40).is_shadow_catcher = True")
still(
    "text",
    "t = bpy.data.curves.new('t', 'FONT'); add('t', t); t.body, t.extrude = 'I', 1",
    ([0, -0.5, -1], [1, 1, 1]),
    sides=0,
)
still(
    "collections",
    """
for i, name in enumerate(("shown", "viewport", "eye", "render", "excluded")):
    c, layer = collection(name)
    box(name, ((0, 0, 0, 50, 60)[i], 0, 0), to=c)
    c.hide_viewport, layer.hide_viewport = name == "viewport", name == "eye"
    c.hide_render, layer.exclude = name == "render", name == "excluded"
""",
)
still(
    "an instance and what is hidden in it",
    """
inner, off = bpy.data.collections.new("inner"), bpy.data.collections.new("off")
inner.children.link(off)
off.hide_render = True
box("in", to=inner)
box("in off", (90, 0, 0), to=off)
e = add("e", None, (5, 0, 0))
e.instance_type, e.instance_collection = "COLLECTION", inner
""",
    at(5),
)
still(
    "modifiers of renders alone",
    """
m = box().modifiers.new("a", "ARRAY")
m.count, m.relative_offset_displace, m.show_viewport = 2, (2, 0, 0), False
m = box("b").modifiers.new("a", "ARRAY")
m.count, m.relative_offset_displace, m.show_render = 20, (0, 2, 0), False
""",
    ([-1, -1, -1], [5, 1, 1]),
)
still(
    "equal names in two libraries",
    "libraries(lambda i: box(location=(4 * i, 0, 0)))",
    ([-1, -1, -1], [5, 1, 1]),
)
still(
    "cameras of equal names",
    """
box()
for camera in libraries(lambda i: eye(location=(0, -9 - 5 * i, 0))):
    camera.select_set(True)
""",
    sides=2,
)
still(
    "another scene behind, another layer",
    """
b, two = box(), bpy.data.scenes.new("two")
far = bpy.data.objects.new("far", b.data)
far.location = (0, 0, 30)
two.collection.objects.link(b)
two.collection.objects.link(far)
scene.background_set = two
b.hide_set(True, view_layer=scene.view_layers.new("second"))
""",
)
still(
    "settings of every kind",
    """
box()
r, layer = scene.render, bpy.context.view_layer
for name in ("use_border", "use_crop_to_border", "use_motion_blur", "use_freestyle", "use_multiview", "use_simplify",
             "use_stamp"):
    setattr(r, name, True)
r.border_max_x, r.resolution_percentage, r.pixel_aspect_x, r.dither_intensity = 0.5, 50, 2, 2
r.fps, r.fps_base, r.image_settings.file_format = 24, 1.001, "JPEG"
scene.cycles.use_denoising, scene.cycles.film_exposure, scene.cycles.sample_offset = True, 3, 100
if hasattr(scene.cycles, "use_sample_subset"):
    scene.cycles.use_sample_subset, scene.cycles.sample_subset_length = True, 1
scene.view_settings.view_transform, scene.view_settings.exposure = "Raw", 3
for name in [x for x in dir(layer) if x.startswith("use_pass_")]:
    setattr(layer, name, True)
layer.samples, layer.name = 1, '名 "q" .Combined.R' + "x" * 30
layer.material_override = bpy.data.materials.new("clay")
scene.world, r.engine = None, "BLENDER_WORKBENCH"
""",
)
for kind, code in {
    "only lights": "add('l', bpy.data.lights.new('l', 'SUN'))",
    "only an empty": "add('e', None)",
    "nothing": "pass",
}.items():
    scene(kind, code=code, said="There is nothing to capture")

# ---------------------------------------------------------------- what moves

scene("the frame by a driver", at(1), at(2), code="driver(box(), 'location', 0, 'frame')", moves=(1, 0, 0))
scene(
    "the scene's frame by a driver", at(1), at(2), moves=(1, 0, 0),
    code="driver(box(), 'location', 0, 'v', v='frame_current')",
)  # fmt: skip
scene("a property of the scene", at(1), at(3), code="""
for frame, value in ((1, 1.0), (2, 3.0)):
    scene["v"] = value
    scene.keyframe_insert('["v"]', frame=frame)
driver(box(), "location", 0, "v", v='["v"]')
""")  # fmt: skip
scene("negative frames", at(-7), at(-6), moves=(1, 0, 0), code="""
driver(box(), "location", 0, "frame")
return steps(-7, -6)
""")  # fmt: skip
scene("remapped time", at(6), at(8), moves=(2, 0, 0), code="""
driver(box(), "location", 0, "frame")
scene.render.frame_map_old, scene.render.frame_map_new = 100, 50
return steps(3, 4)
""")  # fmt: skip
scene("keyed visibility", at(), None, code="key(box(), 'hide_render', {1: False, 2: True})")
scene(
    "keyed in both", None, at(),
    code="b = box(); key(b, 'hide_render', {1: True, 2: False}); key(b, 'hide_viewport', {1: True, 2: False})",
)  # fmt: skip
scene(
    "one of an armature's", at(), at(0, 0, 3),
    code="""
a = add("a", bpy.data.armatures.new("a"))
bpy.context.view_layer.objects.active = a
bpy.ops.object.mode_set(mode="EDIT")
a.data.edit_bones.new("bone").tail = (0, 1, 0)
bpy.ops.object.mode_set(mode="OBJECT")
b = box()
b.modifiers.new("a", "ARMATURE").object = a
b.vertex_groups.new(name="bone").add(range(8), 1, "REPLACE")
key(a.pose.bones[0], "location", {1: (0, 0, 0), 2: (0, 0, 3)})
a.select_set(False)
b.select_set(True)
box("other", (0, 0, 60)).select_set(False)
return dict(source="SELECTED")
""",
)  # fmt: skip
FALLEN = -0.5 * 9.81 * (20 / 24) ** 2
scene(
    "a rigid body that was never played", at(), at(0, 0, FALLEN + 0.02),
    code="""
b = box()
bpy.context.view_layer.objects.active = b
bpy.ops.rigidbody.object_add()
return steps(1, 21, 20)
""",
)  # fmt: skip
scene(
    "cloth that was never played", at(), ([-1, -1, -2.4], [1, 1, -0.4]),
    code="box().modifiers.new('c', 'CLOTH'); return steps(1, 21, 20)",
)  # fmt: skip

# ---------------------------------------------------------------- cameras

ONE = "box(location=(1, 0, 1))\n"
scene("markers with a camera", at(), at(), code="""
box()
e = eye(location=(50, 50, 50), select=False)
for f in (1, 2):
    scene.timeline_markers.new("m", frame=f).camera = e
""")  # fmt: skip
still("lens shift", ONE + "d = eye().data; d.shift_x, d.shift_y = 0.2, -0.1", at(1, 0, 1), sides=2)
still("a keyed lens", ONE + "key(eye(location=(0, -14, 0)).data, 'lens', {1: 60, 2: 35})", at(1, 0, 1), sides=2)
still("a vertical sensor", "box(); d = eye().data; d.sensor_fit, d.sensor_height = 'VERTICAL', 30", sides=2)
still("a mirrored camera", ONE + "eye().scale = (-1, 1, 1)", at(1, 0, 1), sides=2)
still("a scaled camera", ONE + "eye().scale = (3, 0.5, 7)", at(1, 0, 1), sides=2)
still(
    "a sheared camera",
    ONE + "e = add('e', None); e.scale = (1, 1, 2); eye(turn=(1.6, 0.2, 0.05), parent=e)",
    at(1, 0, 1),
    sides=2,
)
still("an own clip range", "box(); eye().data.clip_end = 5", sides=2)
still("a camera inside", "box(); eye(location=(0, 0, 0))", sides=0)
scene("a moving parent", at(), at(), sides=2, code="""
box()
p = add("p", None)
key(p, "location", {1: (0, 0, 0), 2: (1, 0, 0)})
eye(parent=p)
""")  # fmt: skip
scene("a camera that looks away", None, None, code="box(); eye(turn=(-np.pi / 2, 0, 0))")
scene("no scale", code="box(); eye().scale = (0, 0, 0)", said="looks nowhere")
scene("a panorama", code="box(); eye().data.type = 'PANO'", said="not a perspective")
for how in ("layer.exclude = True", "layer.hide_viewport = True", "c.objects[0].hide_viewport = True"):
    scene(f"a rig with {how.split()[0]}", at(0, -1, 0, 0), at(0, 1, 0, 0), sides=-1, code=f"""
box()
bpy.ops.timesplat.add_cameras(rig="ROTATING", distance=4)
c = bpy.data.collections[settings.RIG_COLLECTION]
layer = bpy.context.view_layer.layer_collection.children[c.name]
{how}
bpy.ops.object.select_all(action="DESELECT")
""")  # fmt: skip
NAMES = ("камера", "カメラ", "Cam.A", "cam-a")
still("camera names", f"box()\nfor i, n in enumerate({NAMES}): eye(n, (0, -9 - i, 0))", sides=2)


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes")
    (folder / "out").mkdir()
    code = SETUP
    for name, s in SCENES.items():
        body = "\n".join("    " + line for line in s.code.strip().splitlines())
        code += f"\ndef make(scene):\n{body}\nprint('CASE', {name!r}, flush=True)\ncase({name!r}, make)\n"
    run = Runner(folder / "blender", CHECKOUT)
    return folder / "out", run(code + "\ntell(told=told)", folder / "out")["told"]


def world_points(seq, i):
    """(N,3) what view i sees, and (N,2) how far its flow is from where `moves` leads, as a function of that."""
    y, x = np.mgrid[: seq.height, : seq.width] + 0.5
    v, p = seq.views[i], seq.load_passes(i)
    hit = np.isfinite(p.depth) & (seq.load_image(i)[..., 3] > 250)
    c2w = seq.normalisation.to_world(v.c2w)
    ray = np.stack([(x - v.cx) / v.fx, -(y - v.cy) / v.fy, -np.ones_like(x)], -1)
    points = (ray * (p.depth * seq.normalisation.scale)[..., None])[hit] @ c2w[:3, :3].T + c2w[:3, 3]

    def flow_error(moves):
        local = (points + moves - c2w[:3, 3]) @ c2w[:3, :3]
        there = np.stack([v.cx - v.fx * local[:, 0] / local[:, 2], v.cy + v.fy * local[:, 1] / local[:, 2]], -1)
        return p.flow_next[hit] - (there - np.stack([x, y], -1)[hit])

    pixel = np.median(p.depth[hit]) * seq.normalisation.scale / v.fx if hit.any() else 0
    return points, pixel, flow_error


@pytest.mark.parametrize("name", SCENES)
def test_the_box_is_where_it_is(told, name):
    expected, (folder, all_said) = SCENES[name], told
    said = all_said[name]
    if expected.said:
        assert expected.said in said and said.endswith(".") and "\n" not in said
        return
    assert said == ""
    seq = read_sequence(Path(folder) / name)
    assert len({v.image.lower() for v in seq.views}) == len(seq.views)
    assert not seq.tracks and not seq.untracked  # of use to another method
    for number, box in enumerate(expected.boxes):
        seen = [world_points(seq, i) for i in seq.select(frame=number)]
        points = np.concatenate([p for p, _, _ in seen])
        if box is None:
            assert len(points) == 0
            continue
        low, high = np.array(box, float)
        near = 1.5 * max(pixel for _, pixel, _ in seen)
        found = points.min(0), points.max(0)
        if expected.sides < 0:  # a point that is seen in the middle of each picture
            assert abs(np.median(points, 0) - low).max() < near, (found, near)
            continue
        assert (found[0] > low - near).all() and (found[1] < high + near).all(), (found, near)
        whole = (np.abs(found[0] - low) < near) & (np.abs(found[1] - high) < near)
        assert whole.sum() >= expected.sides, (found, near)
        if expected.moves:
            assert all(np.median(np.abs(error(expected.moves)), 0).max() < 0.1 for p, _, error in seen if len(p))
