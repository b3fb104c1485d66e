# SPDX-License-Identifier: GPL-3.0-or-later
"""Camera rigs as ordinary cameras, and what is captured from them."""

import numpy as np
import pytest

from timesplat.datagen import rigs
from timesplat.datagen.sequence import Normalisation

SCENE = """
part("addon").register()
scene = bpy.context.scene
cube = bpy.data.objects["Cube"]
cube.location, cube.scale = (4, -1, 2), (1, 1, 1.5)
scene.frame_start, scene.frame_end = 3, 7
def poses():
    rig = bpy.data.collections["Timesplat Cameras"].objects
    found = {}
    for frame in range(3, 8):
        scene.frame_set(frame)
        for o in rig:
            found.setdefault(o.name, []).append([list(r) for r in o.matrix_world])
    return found
"""
ADD = """
done = bpy.ops.timesplat.add_cameras(**json.loads(sys.argv[1]))
keyed = {o.name: bool(o.animation_data) for o in bpy.data.collections["Timesplat Cameras"].objects}
tell(done=list(done), poses=poses(), keyed=keyed, selected=[o.name for o in bpy.context.selected_objects],
     fov=[float(np.degrees(o.data.angle)) for o in bpy.data.collections["Timesplat Cameras"].objects])
"""
CORNER = float(np.linalg.norm([1, 1, 1.5]))  # how far the box's corners are from its middle
BOX = Normalisation(CORNER / rigs.RADIUS, (4.0, -1.0, 2.0))
NUMBERS = range(5)
EXPECTED = {
    "CANONICAL": ({}, rigs.canonical(NUMBERS)),
    "ROTATING": ({}, rigs.rotating(NUMBERS)),
    "TURNTABLE": ({"elevation": np.radians(20)}, rigs.turntable(NUMBERS)),
    "DOME": (
        {"count": 3, "distance": 4.0},
        [
            rigs.Shot(f, f"dome{k}", "", rigs.spherical(137.508 * k, np.degrees(np.arcsin(height)), 4))
            for f in NUMBERS
            for k, height in enumerate(np.linspace(-0.5, np.sin(np.radians(75)), 7)[1::2])
        ],
    ),
    "ORBIT": (
        {"count": 3, "distance": 4.0, "elevation": np.radians(-10)},
        [rigs.Shot(f, f"orbit{k}", "", rigs.spherical(120 * k, -10, 4)) for f in NUMBERS for k in range(3)],
    ),
}


@pytest.mark.parametrize("rig", EXPECTED)
def test_cameras_stand_where_the_rig_says(blender, rig):
    import json

    options, shots = EXPECTED[rig]
    told = blender(SCENE + ADD, json.dumps({"rig": rig, **options}))
    names = {s.camera for s in shots}
    assert told["done"] == ["FINISHED"] and set(told["poses"]) == set(told["selected"]) == names
    for shot in shots:
        np.testing.assert_allclose(told["poses"][shot.camera][shot.frame], BOX.to_world(shot.c2w), atol=2e-5)
    assert set(told["keyed"].values()) == {rig in ("ROTATING", "TURNTABLE")}
    np.testing.assert_allclose(told["fov"], 50, atol=1e-3)


AGAIN = """
other = bpy.data.objects["Camera"]
bpy.ops.timesplat.add_cameras(rig="ORBIT", count=5)
bpy.ops.timesplat.add_cameras(rig="CANONICAL")
replaced = sorted(o.name for o in bpy.data.objects if o.type == "CAMERA")
bpy.ops.timesplat.add_cameras(rig="TURNTABLE", replace=False)
kept = len(bpy.data.collections["Timesplat Cameras"].objects)
for o in list(bpy.data.objects):
    if o.type == "MESH":
        bpy.data.objects.remove(o)
try:
    bpy.ops.timesplat.add_cameras()
except RuntimeError as e:
    said = str(e)
tell(replaced=replaced, kept=kept, said=said, cameras=len(bpy.data.cameras), active=scene.camera.name)
"""


def test_a_rig_replaces_the_one_before(blender):
    told = blender(SCENE + AGAIN)
    assert told["replaced"] == ["Camera", "back", "front", "left", "right"] and told["active"] == "Camera"
    assert told["kept"] == 5 and told["cameras"] == 6 and "nothing to capture" in told["said"]
