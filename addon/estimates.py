# SPDX-License-Identifier: GPL-3.0-or-later
"""How long a reconstruction will take and how many Gaussians it will have, before it starts."""

from __future__ import annotations

import contextlib
import json
from dataclasses import dataclass

from . import settings as selected
from .runtime.folders import user_folder

# Gaussians a pixel that counts (`_pixels_that_count`): the mean of 12 objects (tracks: 7, deform: 4), until one is made
_gaussians_a_pixel = {"tracks": 0.63, "guided": 0.19, "lift": 0.19, "deform": 0.2}
TRACKED = (4000, 100_000)  # fewest and most points that are followed
START_SECONDS = 3.0  # of a process
FIT_SECONDS = 5.0  # of a budget's own fit, of pictures of USUAL_PIXELS
USUAL_PIXELS = 128**2  # of a picture
USUAL_GAUSSIANS = 4000  # that a fit of pictures of USUAL_PIXELS uses at most, and in proportion to their sides
SECONDS_A_PIXEL = {"tracks": 1e-6, "guided": 1.3e-6, "lift": 8e-7, "deform": 3e-7}  # seconds a pixel, one thread
# Seconds of a step, one thread: for each pixel of a picture, and for each Gaussian.
STEP_A_PIXEL, STEP_A_GAUSSIAN = 3e-7, 1e-6
# As the worker has them (a test compares): longest side in pixels, steps and most Gaussians of a quality …
QUALITIES = {
    "DRAFT": (128, 300, 10_000),
    "BALANCED": (256, 1500, 30_000),
    "FINE": (512, 4000, 100_000),
    "BEST": (1024, 15_000, 200_000),
}
MOST_STEPS = {"guided": 3000, "lift": 3000}  # … and the steps beyond which a method gains nothing
TRACK_STEPS = (600, 25)  # of tracks: so many, or so many a picture if that is more
# What the last Jobs on this machine took, kept between sessions: seconds a pixel and sample of a capture, and how many
# times longer than by the figures above a reconstruction.
_learnt = {"seconds_a_sample": 2e-7, "pace": 1.0}
WILDEST = 20.0  # times that figures of other sessions, or of a Job that the machine slept through, may be off


@dataclass
class Estimate:
    """What a reconstruction comes to, roughly; times in seconds."""

    pictures: int
    rendering: float
    reconstructing: float
    gaussians: int


def estimate(settings, context) -> Estimate:
    """Nothing is evaluated or read for it. Raises InputError for an empty range of frames."""
    n = selected.picture_count(settings, context)
    quality, method = selected.quality(settings), selected.expected_method(settings, context)
    pixels = n * settings.size**2
    predicted = _gaussians_a_pixel[method] * _pixels_that_count(method, n, settings.size)
    fit, most = settings.refine, predicted
    if method == "tracks":
        predicted = most = min(max(predicted, TRACKED[0]), TRACKED[1])
    elif method == "deform":
        most = predicted
    else:
        if settings.budget != "ALL":
            fit = fit or FIT_SECONDS * max(settings.size**2 / USUAL_PIXELS, 1)
        if fit or quality != "SECONDS":
            most = USUAL_GAUSSIANS * settings.size / USUAL_PIXELS**0.5
    if quality != "SECONDS":
        most = min(most, QUALITIES[quality][2])
    kept = {"SHARE": predicted * settings.share / 100, "NUMBER": settings.number}.get(settings.budget, predicted)
    count = min(kept, most, predicted)
    if quality != "SECONDS":
        fit = _fit_seconds(settings, method, n, count)
    fits = 3 if settings.budget == "AUTO" else 1
    rendering = START_SECONDS + pixels * settings.samples * _learnt["seconds_a_sample"]
    reconstructing = START_SECONDS + pixels * SECONDS_A_PIXEL[method] + fit * fits
    return Estimate(n, rendering, reconstructing * _learnt["pace"], round(count))


def _fit_seconds(settings, method: str, pictures: int, gaussians: float) -> float:
    """Of the steps of a quality with so many Gaussians."""
    size, steps, _ = QUALITIES[settings.quality]
    least, each = TRACK_STEPS
    most = max(least, each * pictures) if method == "tracks" else MOST_STEPS.get(method, steps)
    size = settings.size / -(-settings.size // size)  # averaged down by a whole factor
    return min(steps, most) * (size**2 * STEP_A_PIXEL + gaussians * STEP_A_GAUSSIAN)


def learn_speed(seconds: float, pixels: int, samples: int) -> None:
    """Remembers how fast this machine captures."""
    _learnt["seconds_a_sample"] = max(seconds - START_SECONDS, 0.1) / max(pixels * samples, 1)
    _keep()


def learn_pace(seconds: float, expected: float) -> None:
    """Remembers how long a reconstruction took that had been expected to take so long."""
    if seconds > 0 and expected > 0:
        pace = _learnt["pace"] * seconds / expected
        _learnt["pace"] = min(max(pace, 1 / WILDEST), WILDEST)
        _keep()


def _keep() -> None:
    with contextlib.suppress(OSError):  # it is only an estimate
        (user_folder("estimates") / "learnt.json").write_text(json.dumps(_learnt))


def register() -> None:
    """Takes up what was learnt in earlier sessions."""
    try:
        found = json.loads((user_folder("estimates", create=False) / "learnt.json").read_text())
        kept = {k: float(found[k]) for k, usual in _learnt.items() if 1 / WILDEST < float(found[k]) / usual < WILDEST}
    except (OSError, ValueError, KeyError, TypeError):
        return
    _learnt.update(kept)


def unregister() -> None:
    pass


def learn_number(method: str, gaussians: int, pictures: int, size: int) -> None:
    """Remembers, for this session, how many Gaussians a method made of so many pictures of this size."""
    _gaussians_a_pixel[method] = gaussians / max(_pixels_that_count(method, pictures, size), 1)


def _pixels_that_count(method: str, pictures: int, size: int) -> int:
    """The pixels that the number of Gaussians goes by: those of all pictures, but of one for tracks and what
    comes to be tracks, which lie on the surface as densely as its pixels."""
    return size**2 * (1 if method in ("tracks", "deform") else pictures)
