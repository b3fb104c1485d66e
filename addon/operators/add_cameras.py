# SPDX-License-Identifier: GPL-3.0-or-later
"""Camera rigs as ordinary cameras, to be seen, moved and keyed like any other: Add > Camera > Timesplat Rig, and
the panel. They lie in one collection, which Reconstruct takes where no camera is selected."""

import math

import bpy
import numpy as np
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty
from mathutils import Matrix

from ...datagen import rigs
from ...datagen.scene.measure import normalisation
from ...datagen.sequence import InputError
from .. import settings
from ..asset.visibility import captured

RIGS = [
    ("CANONICAL", "Four Sides", "Four cameras that stand still: front, left, back, right"),
    ("ORBIT", "Orbit", "Cameras that stand still, evenly around the object"),
    ("DOME", "Dome", "Cameras that stand still, evenly all around, above and below"),
    ("TURNTABLE", "Turntable", "One camera that goes once around the object"),
    ("RANDOM", "Random", "Cameras that stand still anywhere around, from below to above"),
    ("ROTATING", "Two Rotating", "Two cameras that go from the front to the back, one on each side"),
]
ADVANCED = ("ROTATING",)
LOWEST, HIGHEST = -30, 75  # elevations of a dome, in degrees
GOLDEN = 137.508  # degrees


def shots(rig: str, count: int, elevation: float, distance: float, frames: list[int]) -> list[rigs.Shot]:
    """The cameras of a rig at each of the frames, in normalised space; `Shot.frame` counts them. elevation in
    degrees, distance in half-sides of the object's box; a camera that never moves has the same pose in all."""
    numbers = range(len(frames))
    last = max(len(frames) - 1, 1)
    if rig == "CANONICAL":
        around = [(name, [azimuth] * len(frames)) for name, azimuth in rigs.CANONICAL.items()]
    elif rig == "ROTATING":
        ways = {"via_left": 180 / last, "via_right": -180 / last}
        around = [(name, [step * i for i in numbers]) for name, step in ways.items()]
    elif rig == "ORBIT":
        around = [(f"orbit{k}", [360 * k / count] * len(frames)) for k in range(count)]
    elif rig in ("DOME", "RANDOM"):
        places = _dome(count) if rig == "DOME" else _random(count)
        poses = [rigs.spherical(azimuth, height, distance) for azimuth, height in places]
        name = rig.lower()
        return [rigs.Shot(i, f"{name}{k}", name, pose) for i in numbers for k, pose in enumerate(poses)]
    else:
        around = [("turntable", [360 * i / len(frames) for i in numbers])]
    return [
        rigs.Shot(i, name, rig.lower(), rigs.spherical(azimuths[i], elevation, distance))
        for i in numbers
        for name, azimuths in around
    ]


def _dome(count: int) -> list[tuple[float, float]]:
    """Azimuth and elevation in degrees, evenly over what lies between LOWEST and HIGHEST."""
    low, high = (math.sin(math.radians(x)) for x in (LOWEST, HIGHEST))
    heights = [low + (high - low) * (k + 0.5) / count for k in range(count)]
    return [(GOLDEN * k % 360, math.degrees(math.asin(h))) for k, h in enumerate(heights)]


def _random(count: int) -> list[tuple[float, float]]:
    rng = np.random.default_rng(0)
    return [(rng.uniform(0, 360), rng.uniform(LOWEST, 60)) for _ in range(count)]


class TIMESPLAT_OT_add_cameras(bpy.types.Operator):
    """Put cameras around what is to be captured"""

    bl_idname = "timesplat.add_cameras"
    bl_label = "Timesplat Rig"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    rig: EnumProperty(name="Rig", items=RIGS)
    count: IntProperty(name="Cameras", description="Of an orbit, a dome or at random", default=12, min=1, max=64)
    elevation: FloatProperty(
        name="Elevation", description="Above the horizon, where all are level", default=0,
        min=-math.pi / 2, max=math.pi / 2, subtype="ANGLE",
    )  # fmt: skip
    distance: FloatProperty(
        name="Distance",
        description="From the object's middle, in halves of its longest side; the network was trained at 2.7",
        default=rigs.DISTANCE,
        min=1.5,
        max=20,
    )
    replace: BoolProperty(name="Replace", description="Remove the rig's former cameras", default=True)

    @classmethod
    def poll(cls, context):
        cls.poll_message_set("Cameras are added in Object Mode; leave the mode that you are in.")
        return context.mode == "OBJECT"

    def execute(self, context):
        scene, chosen = context.scene, context.scene.timesplat
        try:
            frames = settings.frames(chosen, scene)
            some = sorted({frames[round(i * (len(frames) - 1) / 11)] for i in range(12)})
            objects = settings.objects(chosen, context)
            with captured(objects):
                norm, _ = normalisation(some, objects, name=scene.name, rendered=False)
        except InputError as e:
            self.report({"ERROR"}, str(e))
            return {"CANCELLED"}
        for ob in list(context.view_layer.objects.selected):
            ob.select_set(False)
        if self.replace and (old := bpy.data.collections.get(settings.RIG_COLLECTION)):
            for ob in [o for o in old.objects if o.type == "CAMERA"]:  # batch_remove crashes 4.3 when it is undone
                data = ob.data
                bpy.data.objects.remove(ob)
                if not data.users:
                    bpy.data.cameras.remove(data)
        name = settings.RIG_COLLECTION
        collection = bpy.data.collections.get(name) or bpy.data.collections.new(name)
        if name not in scene.collection.children:
            scene.collection.children.link(collection)
        placed: dict[str, list] = {}
        for shot in shots(self.rig, self.count, math.degrees(self.elevation), self.distance, frames):
            placed.setdefault(shot.camera, []).append(Matrix(norm.to_world(shot.c2w).tolist()))
        for name, poses in placed.items():
            collection.objects.link(ob := _camera(name, norm.scale))
            moves = any(pose != poses[0] for pose in poses)
            for frame, pose in zip(frames, poses, strict=True):
                ob.matrix_world = pose
                if not moves:
                    break
                ob.keyframe_insert("location", frame=frame)
                ob.keyframe_insert("rotation_quaternion", frame=frame)
        context.view_layer.update()  # new objects are not in it before
        for ob in collection.objects:
            if ob.name in context.view_layer.objects:
                ob.select_set(True)
        scene.camera = scene.camera or collection.objects[0]
        return {"FINISHED"}


def _camera(name: str, scale: float):
    data = bpy.data.cameras.new(name)
    data.angle = math.radians(rigs.FOV)
    data.display_size = 0.3 * scale
    data.clip_start, data.clip_end = 1e-2 * scale, 1e3 * scale
    ob = bpy.data.objects.new(name, data)
    ob.rotation_mode = "QUATERNION"
    return ob


def _menu(self, context):
    self.layout.operator(TIMESPLAT_OT_add_cameras.bl_idname, icon="OUTLINER_OB_CAMERA")


def register() -> None:
    bpy.utils.register_class(TIMESPLAT_OT_add_cameras)
    bpy.types.VIEW3D_MT_camera_add.append(_menu)


def unregister() -> None:
    bpy.types.VIEW3D_MT_camera_add.remove(_menu)
    bpy.utils.unregister_class(TIMESPLAT_OT_add_cameras)
