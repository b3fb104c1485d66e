# SPDX-License-Identifier: GPL-3.0-or-later
"""What the panel and the Reconstruct operator have in common: their settings, what these select in the scene, and
how long it will take."""

from __future__ import annotations

from dataclasses import dataclass

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, StringProperty

from ..datagen.scene import shown_objects
from ..datagen.sequence import InputError
from .asset.sliders import LOOKS

RIG = "Timesplat Cameras"  # the collection that `rigs` puts cameras into
AIM = 24  # frames that "every: automatic" comes near to
SHAPES = ("MESH", "CURVE", "SURFACE", "META", "FONT", "VOLUME", "CURVES", "POINTCLOUD")
METHODS = [
    ("guided", "Guided", "The network, led by depth and motion that Blender renders along"),
    ("lift", "Lift", "Depth and motion straight to Gaussians, without a network: fastest"),
    ("rgb", "Pictures Only", "The network from colour alone, as it would be for photographs"),
]
BUDGETS = [
    ("ALL", "All", "Every Gaussian that was predicted"),
    ("SHARE", "Share", "A share of those predicted, fitted to the pictures: fewer and better"),
    ("NUMBER", "Number", "At most so many, fitted to the pictures"),
    ("AUTO", "Automatic", "As few as the scene needs: several fits"),
]


class Settings:
    """Mixed into the operator and into the scene's property group."""

    source: EnumProperty(
        name="Object",
        description="What is captured; Gaussian assets are always left out",
        items=[
            ("SCENE", "All", "Everything that renders show"),
            ("SELECTED", "Selected", "The selected objects and their children"),
            ("COLLECTION", "Collection", "The objects of a collection"),
        ],
    )
    collection: StringProperty(name="Collection", description="The collection to capture")
    in_turn: BoolProperty(
        name="One Camera a Frame",
        description="Cameras take turns, a picture a frame: fewer pictures, less time",
    )
    frame_range: EnumProperty(
        name="Frames",
        items=[("SCENE", "Scene", "The scene's frame range"), ("CUSTOM", "Range", "A range of its own")],
    )
    frame_start: IntProperty(name="Start", default=1)
    frame_end: IntProperty(name="End", default=24)
    every: IntProperty(
        name="Every n-th",
        description=f"Capture every n-th frame; 0: so many that there are at most {AIM}",
        min=0,
        max=1000,
    )
    size: IntProperty(name="Resolution", description="Pixels a side", default=128, min=16, max=2048, step=8)
    samples: IntProperty(name="Samples", description="Cycles samples a pixel", default=16, min=1, max=4096)
    lighting: BoolProperty(
        name="Even Light",
        description="Three suns and a grey world, which the network was trained with, in place of the scene's lights",
        default=True,
    )
    method: EnumProperty(name="Method", items=METHODS, default="guided")
    refine: FloatProperty(
        name="Refine",
        description="Seconds for which the Gaussians are fitted to the pictures. 0: none where all are kept; for fewer "
        "as long as it takes, 5 s for pictures of 128 pixels and more for larger ones",
        default=0.0,
        min=0.0,
        max=3600.0,
        subtype="TIME_ABSOLUTE",
    )
    budget: EnumProperty(name="Gaussians", items=BUDGETS, default="SHARE")
    share: FloatProperty(
        name="Share", description="Of the Gaussians predicted", default=10, min=0.1, max=100, subtype="PERCENTAGE"
    )
    number: IntProperty(name="Number", description="Most Gaussians", default=4000, min=1, max=10_000_000)
    look: EnumProperty(name="Look", items=[(x, x, "") for x in LOOKS], default=LOOKS[0])
    output: StringProperty(name="Save As", description="Also keep the asset as this .ply", subtype="FILE_PATH")


KEYS = tuple(Settings.__annotations__)


class TIMESPLAT_PG_settings(Settings, bpy.types.PropertyGroup):
    pass


# ---------------------------------------------------------------- what they select


def spread(first: int, last: int, count: int) -> range:
    """At most `count` frame numbers from `first` on with one whole step between them, the smallest that
    comes within a step of `last`: an even step is what motion vectors and time need."""
    step = max(1, -(-(last - first) // max(count - 1, 1)))
    return range(first, last + 1, step)[:count]


def frames(settings, scene) -> range:
    """The scene frames to capture. Raises InputError for an empty range."""
    own = settings.frame_range == "CUSTOM"
    first, last = (settings.frame_start, settings.frame_end) if own else (scene.frame_start, scene.frame_end)
    if last < first:
        raise InputError(f"Frames {first} to {last}: the range is empty; let it end after its start.")
    return range(first, last + 1, settings.every) if settings.every else spread(first, last, AIM)


def objects(settings, context) -> list:
    """The objects that cameras shall see. Raises InputError where there is no such collection or nothing in it
    that could be seen."""
    scene = context.scene
    shown = [o for o in shown_objects(scene, context.view_layer) if not o.get("timesplat")]
    if settings.source == "SELECTED":
        family = {o for s in context.view_layer.objects.selected for o in (s, *s.children_recursive)}
        shown = [o for o in shown if o in family or o.type == "LIGHT"]
    elif settings.source == "COLLECTION":
        collection = bpy.data.collections.get(settings.collection)
        if collection is None:
            raise InputError(f"{settings.collection or 'Collection'}: no such collection; choose one.")
        inside = set(collection.all_objects)
        shown = [o for o in shown if o in inside or o.type == "LIGHT"]
    if not any(o.type in SHAPES or o.instance_type == "COLLECTION" for o in shown):
        raise InputError("There is nothing to capture: no mesh is chosen that renders show; choose another Object.")
    return shown


def cameras(context) -> tuple[list, str]:
    """-> (camera objects to take pictures with, what to call them): the selected ones, else those of the rig,
    else none: canonical views in turn."""
    selected = [o for o in context.view_layer.objects.selected if o.type == "CAMERA"]
    if selected:
        return selected, f"{len(selected)} selected camera{'s' * (len(selected) > 1)}"
    rig = bpy.data.collections.get(RIG)
    placed = [o for o in rig.objects if o.type == "CAMERA" and o.name in context.scene.objects] if rig else []
    if placed:
        return placed, f"{len(placed)} camera{'s' * (len(placed) > 1)} of the rig"
    return [], "Front, left, back, right in turn"


def budget(settings) -> str | None:
    """The budget as the worker has it."""
    return {"ALL": None, "SHARE": f"{settings.share:g}%", "NUMBER": str(settings.number), "AUTO": "auto"}[
        settings.budget
    ]


# ---------------------------------------------------------------- how long it takes

# Gaussians a pixel of the pictures: the mean of 12 objects, until one was made here
_fill = {"guided": 0.19, "lift": 0.19, "rgb": 0.11}
START, FITTING = 3.0, 5.0  # seconds: a process's start; a budget's own fit of pictures of PIXELS
PIXELS = 128**2
FITTED = 4000  # Gaussians that a fit of pictures of PIXELS uses at most, and in proportion to their sides
PIXEL = {"guided": 1.3e-6, "lift": 8e-7, "rgb": 1.8e-6}  # seconds a pixel, one thread
_rate = 2e-7  # seconds a pixel and sample; replaced by what the last capture took


@dataclass
class Estimate:
    """What a reconstruction comes to, roughly; times in seconds."""

    pictures: int
    rendering: float
    reconstructing: float
    gaussians: int


def estimate(settings, context) -> Estimate:
    """Nothing is evaluated or read for it. Raises InputError for an empty range of frames."""
    n = len(frames(settings, context.scene))
    placed, _ = cameras(context)
    n *= 1 if settings.in_turn or not placed else len(placed)
    pixels = n * settings.size**2
    predicted = _fill[settings.method] * pixels
    fit = settings.refine or (FITTING * max(settings.size**2 / PIXELS, 1) if settings.budget != "ALL" else 0)
    most = FITTED * settings.size / PIXELS**0.5 if fit else predicted
    kept = {"SHARE": predicted * settings.share / 100, "NUMBER": settings.number}.get(settings.budget, predicted)
    count = min(kept, most, predicted)
    reconstructing = START + pixels * PIXEL[settings.method] + fit * (3 if settings.budget == "AUTO" else 1)
    return Estimate(n, START + pixels * settings.samples * _rate, reconstructing, round(count))


def learn(seconds: float, pixels: int, samples: int) -> None:
    """Remembers, for this session, how fast this machine captures."""
    global _rate
    _rate = max(seconds - START, 0.1) / max(pixels * samples, 1)


def learn_number(method: str, gaussians: int, pixels: int) -> None:
    """Remembers, for this session, how many Gaussians were predicted from so many pixels."""
    _fill[method] = gaussians / max(pixels, 1)


def register() -> None:
    bpy.utils.register_class(TIMESPLAT_PG_settings)
    bpy.types.Scene.timesplat = bpy.props.PointerProperty(type=TIMESPLAT_PG_settings)


def unregister() -> None:
    del bpy.types.Scene.timesplat
    bpy.utils.unregister_class(TIMESPLAT_PG_settings)
