# SPDX-License-Identifier: GPL-3.0-or-later
"""What the panel and the Reconstruct operator have in common: their settings, and what these select in the scene."""

from __future__ import annotations

import contextlib

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, StringProperty

from ..datagen.rigs import COVERAGE_VIEWS
from ..datagen.scene.borrow import shown_objects
from ..datagen.sequence import InputError
from . import survey
from .asset.sliders import LOOKS
from .asset.visibility import HIDDEN

RIG_COLLECTION = "Timesplat Cameras"  # the collection that `rigs` puts cameras into
MOST_AUTOMATIC_FRAMES = 24  # frames that "every: automatic" comes near to
MANY = 50  # objects, of which it takes milliseconds to find out
CAPTURED_TYPES = ("MESH", "CURVE", "SURFACE", "META", "FONT", "VOLUME", "CURVES", "POINTCLOUD")
METHODS = [
    (
        "tracks",
        "Tracks",
        "Surface points that Blender follows through the clip, with looks that all pictures share: sharpest",
    ),
    ("guided", "Guided", "The network, led by depth and motion that Blender renders along"),
    ("lift", "Lift", "Depth and motion straight to Gaussians, without a network: fastest"),
    (
        "deform",
        "Pictures Only",
        "One cloud and its motion, fitted to colour alone, as to photographs: for what has no surface",
    ),
]
QUALITIES = [  # what they mean is the worker's (model/fitting/quality.py): steps, not seconds
    ("DRAFT", "Draft", "A few steps, at most 10,000 Gaussians: for pictures of 128 pixels"),
    ("BALANCED", "Balanced", "At most 30,000 Gaussians, for pictures of 256 pixels"),
    ("FINE", "Fine", "At most 100,000 Gaussians, for pictures of 512 pixels"),
    ("BEST", "Best", "As much as ever gains anything, for pictures of 1024 pixels"),
    ("SECONDS", "Seconds", "As many steps as fit into so many seconds"),
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
        name="Source",
        description="What is captured; Gaussian assets are always left out",
        items=[
            ("SCENE", "All", "Everything that renders show"),
            ("SELECTED", "Selected", "The selected objects and their children"),
            ("COLLECTION", "Collection", "The objects of a collection"),
        ],
    )
    collection: StringProperty(name="Collection", description="The collection to capture")
    leave_out: BoolProperty(
        name="No Surroundings",
        description="With Source at All: a ground, a backdrop or a dome that dwarfs all else is not captured. It would "
        "set the bounds, and what matters would be a few pixels",
        default=True,
    )
    in_turn: BoolProperty(
        name="Alternate Cameras",
        description="Cameras take turns, a picture a frame: fewer pictures, less time",
    )
    frame_range: EnumProperty(
        name="Frames",
        items=[
            ("SCENE", "Scene", "The scene's frame range, or what of it is animated where the last key comes earlier"),
            ("CUSTOM", "Range", "A range of its own"),
        ],
    )
    frame_start: IntProperty(name="Start", default=1)
    frame_end: IntProperty(name="End", default=24)
    every: IntProperty(
        name="Frame Step",
        description="Pictures of every n-th frame; 0: of so many that there are at most "
        f"{MOST_AUTOMATIC_FRAMES}. Tracks follows the surface through those between too",
        min=0,
        max=1000,
    )
    size: IntProperty(name="Resolution", description="Pixels a side", default=256, min=16, max=2048, step=8)
    samples: IntProperty(name="Samples", description="Cycles samples a pixel", default=16, min=1, max=4096)
    lighting: BoolProperty(
        name="Studio Lighting",
        description="Three suns and a grey world, which the network was trained with, in place of the scene's lights",
        default=True,
    )
    method: EnumProperty(name="Method", items=METHODS, default=METHODS[0][0])
    quality: EnumProperty(
        name="Quality",
        description="How much is fitted to the pictures. All but Seconds come out the same however busy the machine is",
        items=QUALITIES,
        default="BALANCED",
    )
    refine: FloatProperty(
        name="Fit",
        description="With Quality at Seconds (which it is where a script names these alone): those for which the "
        "Gaussians are fitted to the pictures, at most. 0: "
        "none for Tracks and where all are kept; for fewer as long as it takes, 5 s for pictures of 128 pixels and "
        "more for larger ones",
        default=10.0,
        min=0.0,
        max=3600.0,
        subtype="TIME_ABSOLUTE",
    )
    budget: EnumProperty(name="Gaussians", items=BUDGETS, default="ALL")
    share: FloatProperty(
        name="Share", description="Of the Gaussians predicted", default=10, min=0.1, max=100, subtype="PERCENTAGE"
    )
    number: IntProperty(name="Number", description="Most Gaussians", default=4000, min=1, max=10_000_000)
    look: EnumProperty(name="Look", items=[(x, x, "") for x in LOOKS], default=LOOKS[0])
    output: StringProperty(name="Save As", description="Also keep the asset as this .ply", subtype="FILE_PATH")


KEYS = tuple(Settings.__annotations__)


def _get_step(settings) -> int:
    return int(settings.every > 0)


def _set_step(settings, value: int) -> None:
    settings.every = max(settings.every, 1) if value else 0


class TIMESPLAT_PG_settings(Settings, bpy.types.PropertyGroup):
    frame_step: EnumProperty(
        name="Frame Step",
        description="Of which frames of the range pictures are taken. Tracks follows the surface through those between "
        "too",
        items=[
            ("AUTO", "Auto", f"As many as there may be with an even step: at most {MOST_AUTOMATIC_FRAMES}"),
            ("EVERY", "Every", "Every n-th"),
        ],
        get=_get_step,
        set=_set_step,
    )


# ---------------------------------------------------------------- what they select


def spread(first: int, last: int, count: int) -> range:
    """At most `count` frame numbers from `first` on with one whole step between them, the smallest that
    comes within a step of `last`: an even step is what motion vectors and time need."""
    step = max(1, -(-(last - first) // max(count - 1, 1)))
    return range(first, last + 1, step)[:count]


def span(settings, scene) -> tuple[int, int]:
    """The first and the last scene frame of the clip. Raises InputError for an empty range."""
    own = settings.frame_range == "CUSTOM"
    first, last = (settings.frame_start, settings.frame_end) if own else (scene.frame_start, scene.frame_end)
    if not own and (end := survey.animation_end(scene.objects)) is not None and first < end < last:
        last = end
    if last < first:
        raise InputError(f"Frames {first} to {last}: the range is empty; let it end after its start.")
    return first, last


def frames(settings, scene) -> range:
    """The scene frames of which pictures are taken. Raises InputError for an empty range."""
    first, last = span(settings, scene)
    return range(first, last + 1, settings.every) if settings.every else spread(first, last, MOST_AUTOMATIC_FRAMES)


def objects(settings, context) -> list:
    """The objects that cameras shall see. Raises InputError where there is no such collection or nothing in it
    that could be seen."""
    scene = context.scene
    shown = [o for o in shown_objects(scene, context.view_layer) if not o.get("timesplat")]
    around = left_out(settings, context)
    shown = [o for o in shown if o not in around]
    if settings.source == "SELECTED":
        family = {o for s in context.view_layer.objects.selected for o in (s, *s.children_recursive)}
        shown = [o for o in shown if o in family or o.type == "LIGHT"]
    elif settings.source == "COLLECTION":
        collection = bpy.data.collections.get(settings.collection)
        if collection is None:
            raise InputError(f"{settings.collection or 'Collection'}: no such collection; choose one.")
        inside = set(collection.all_objects)
        shown = [o for o in shown if o in inside or o.type == "LIGHT"]
    if not any(o.type in CAPTURED_TYPES or o.instance_type == "COLLECTION" for o in shown):
        raise InputError("There is nothing to capture: no mesh is chosen that renders show; choose another Source.")
    return shown


def left_out(settings, context) -> list:
    """The surroundings that are not captured."""
    if settings.source != "SCENE" or not settings.leave_out:
        return []
    return survey.surroundings(captured_shapes(context))


def captured_shapes(context) -> list:
    """The objects that renders show, without lights, cameras and asset objects."""
    found = shown_objects(context.scene, context.view_layer)
    found = [o for o in found if not o.hide_render or o.get(HIDDEN)]
    return [o for o in found if not o.get("timesplat") and o.type not in ("LIGHT", "CAMERA")]


def part_is_selected(context) -> bool:
    """Whether of what would be captured some is selected, with its children, and some is not: what was clicked on last
    is what is meant. Of large scenes only what is selected itself is looked at."""
    scene, selected = context.scene, [o for o in context.selected_objects if o.type in CAPTURED_TYPES]
    selected = [o for o in selected if not o.get("timesplat") and not o.hide_render]
    if not selected or len(scene.objects) > MANY:
        return bool(selected)
    around = set(survey.surroundings(shapes := captured_shapes(context)))
    shapes = {o for o in shapes if o.type in CAPTURED_TYPES} - around
    family = {o for s in selected for o in (s, *s.children_recursive)} & shapes
    return bool(family) and family != shapes


def method(settings, objects: list) -> str:
    """The method that is used: Pictures Only in place of those that follow surfaces, where there hardly is one."""
    return "deform" if survey.mostly_without_surface(objects) else settings.method


def expected_method(settings, context) -> str:
    """As `method`, for what is drawn often: of large scenes nothing is looked at."""
    if len(context.scene.objects) <= MANY:
        with contextlib.suppress(InputError):
            return method(settings, objects(settings, context))
    return settings.method


def cameras(context) -> tuple[list, str]:
    """-> (camera objects to take pictures with, what to call them): the selected ones, else those of the rig,
    else none: the rig `coverage`."""
    selected = [o for o in context.view_layer.objects.selected if o.type == "CAMERA"]
    if selected:
        return selected, f"{len(selected)} selected camera{'s' * (len(selected) > 1)}"
    rig = bpy.data.collections.get(RIG_COLLECTION)
    placed = [o for o in rig.objects if o.type == "CAMERA" and o.name in context.scene.objects] if rig else []
    if placed:
        return placed, f"{len(placed)} camera{'s' * (len(placed) > 1)} of the rig"
    return [], "All sides, above and below in turn"


def picture_count(settings, context) -> int:
    """How many pictures are taken. Raises InputError for an empty range of frames."""
    count, placed = len(frames(settings, context.scene)), len(cameras(context)[0])
    if not placed:
        return count * -(-COVERAGE_VIEWS // count)
    return count if settings.in_turn else count * placed


def budget(settings) -> str | None:
    """The budget as the worker has it."""
    return {"ALL": None, "SHARE": f"{settings.share:g}%", "NUMBER": str(settings.number), "AUTO": "auto"}[
        settings.budget
    ]


def quality(settings) -> str:
    """Of QUALITIES. Where a script names seconds to fit and no quality, it means these."""
    given = getattr(settings, "properties", settings)  # an operator's own are elsewhere
    only_seconds = given.is_property_set("refine") and not given.is_property_set("quality")
    return "SECONDS" if only_seconds else settings.quality


def fit(settings) -> dict:
    """How long is fitted, as the worker has it: a quality, or seconds."""
    if (chosen := quality(settings)) == "SECONDS":
        return {"quality": None, "refine": settings.refine}
    return {"quality": chosen.lower(), "refine": 0.0}


def register() -> None:
    bpy.utils.register_class(TIMESPLAT_PG_settings)
    bpy.types.Scene.timesplat = bpy.props.PointerProperty(type=TIMESPLAT_PG_settings)


def unregister() -> None:
    del bpy.types.Scene.timesplat
    bpy.utils.unregister_class(TIMESPLAT_PG_settings)
