# SPDX-License-Identifier: GPL-3.0-or-later
"""What the artist should know before anything is rendered: sentences for the panel and for the command line."""

from __future__ import annotations

from ..datagen.sequence import InputError
from . import settings, survey
from .estimates import QUALITIES, Estimate

MOST_NAMED = 3  # objects in a sentence
ENCLOSED = 0.8  # of all directions, in which what is captured is seen from inside


def notices(chosen, context, expected: Estimate) -> list[str]:
    """A sentence each. Nothing is evaluated. Raises InputError where nothing can be captured."""
    scene, said = context.scene, []
    if around := settings.left_out(chosen, context):
        said.append(f"Left out as surroundings: {_named(around)}.")
    elif chosen.source == "SCENE" and (around := survey.surroundings(settings.captured_shapes(context))):
        said.append(f"All else will be small in the pictures beside {_named(around)}.")
    objects = [o for o in settings.objects(chosen, context) if o.type != "LIGHT"]
    frames = settings.frames(chosen, scene)
    end = survey.animation_end(scene.objects) if chosen.frame_range == "SCENE" else None
    if end is not None and frames.start < end < scene.frame_end:
        said.append(f"The animation ends at {end}: frames {frames.start} to {end} are captured.")
    camera = scene.camera
    if camera and not settings.cameras(context)[0] and survey.within(camera.matrix_world.translation, objects):
        said.append(f"{camera.name} stands amid what is captured: of a room, select cameras that stand inside too, for "
                    "the default ones stand outside.")  # fmt: skip
    if unseen := survey.without_surface(objects):
        kinds = " and ".join(sorted(set(unseen.values())))
        if chosen.method == "deform":
            pass  # which needs none
        elif settings.method(chosen, objects) == "deform":
            said.append(f"{_named(unseen)}: {kinds} has no surface, so that Pictures Only is used.")
        else:
            said.append(f"{_named(unseen)}: {kinds} has no surface to follow; Pictures Only is for that.")
    strands, grown = survey.hair(objects) if settings.method(chosen, objects) == "tracks" else ([], [])
    if strands:
        said.append(f"{_named(strands)}: hair curves are followed, each strand at least a pixel wide: finer fur needs "
                    "a higher Resolution.")  # fmt: skip
    if grown:
        said.append(f"{_named(grown)}: hair of particle systems is led by motion vectors, which is less sharp; as hair "
                    "curves it is followed.")  # fmt: skip
    if bright := survey.brighter_than_white(objects):
        said.append(f"{_named(bright)}: what glows keeps its colour up to white, and lights nothing new afterwards.")
    if chosen.budget == "NUMBER" and (why := _fewer(chosen, expected)):
        said.append(why)
    return said


def _fewer(chosen, expected: Estimate) -> str:
    """Why there will be fewer Gaussians than were asked for; nothing where there will not."""
    quality = settings.quality(chosen)
    if quality != "SECONDS" and chosen.number > (most := QUALITIES[quality][2]):
        return f"Not {chosen.number:,} but {most:,} Gaussians: Quality {quality.title()} has no more; choose another."
    if chosen.method != "tracks" and expected.gaussians < 0.9 * chosen.number:
        return (
            f"Not {chosen.number:,} but about {expected.gaussians:,} Gaussians: pictures of {chosen.size} pixels give "
            "no more; raise Resolution or Quality."
        )
    return ""


def refuse_views_from_outside(chosen, context) -> None:
    """Raises InputError where the scene's camera stands inside of what is captured and no other camera is chosen: those
    that are taken by default stand outside, and would see walls. And where all that are chosen stand inside, in the
    dark, for Studio Lighting comes from outside."""
    camera, taken = context.scene.camera, settings.cameras(context)[0]
    if camera is None and not taken:
        return
    objects, graph = set(settings.objects(chosen, context)), context.evaluated_depsgraph_get()

    def enclosed(place) -> bool:
        hits = 0
        for way in survey.DIRECTIONS:
            hit, *_, ob, _ = context.scene.ray_cast(graph, place, way)
            hits += bool(hit and ob.original in objects)
        return hits >= ENCLOSED * len(survey.DIRECTIONS)

    if taken:
        if chosen.lighting and all(enclosed(o.matrix_world.translation) for o in taken):
            raise InputError(
                f"{_named(taken)}: they stand inside of what is captured, where Studio Lighting, which comes from "
                "outside, is dark; switch it off and light the room."
            )
        return
    if enclosed(camera.matrix_world.translation):
        others = [o for o in context.scene.objects if o.type == "CAMERA" and enclosed(o.matrix_world.translation)]
        raise InputError(
            f"{camera.name}: it stands inside of what is captured, and the default cameras stand outside; select those "
            f"that stand inside too ({_named(others)}), the more the better, or hide the walls from renders."
        )


def _named(objects) -> str:
    names = [o.name for o in objects]
    return ", ".join(names[:MOST_NAMED]) + (f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else "")
