# SPDX-License-Identifier: GPL-3.0-or-later
"""From views to tracks: the method `tracks`, within a budget where that is asked for.

The points are those that the renderer followed, and where it could not, those that motion vectors lead; their number
follows from the pixels, or from the budget. They start in the colours seen and are fitted to the views.
"""

from __future__ import annotations

import numpy as np

from ...datagen.sequence import InputError
from ...datagen.track_file import SurfaceTracks
from ..geometry.motion_tracks import motion_tracks
from ..geometry.surface_tracks import LED, SETTINGS, TrackSettings, needed_points, surface_tracks
from ..tracks import Tracks4D
from ..views import Views
from .budget import FIRST_TRY, check_loss, parse_budget
from .fit_tracks import FIT, fit_tracks
from .fit_views import psnr, set_aside
from .loop import Schedule, warm_up
from .quality import Quality
from .refine import part

TRY_STEPS = 150  # of each fit by which `auto` looks for the fewest


def reconstruct_tracks(
    views: Views,
    seconds: float,
    *,
    budget: str | None = None,
    max_loss: float = 0.1,
    steps: int | None = None,
    quality: Quality | None = None,
    seed: int = 0,
    progress=None,
) -> Tracks4D:
    """Views with depth, motion vectors and, where the renderer wrote them, tracks of the surface -> tracks, after at
    most `seconds` of fitting, or exactly `steps`, or the steps of `quality`, but no more than these views are worth,
    and no more tracks than it says; as they start for 0. budget: see `parse_budget`; a share is of the points that the
    pixels need. max_loss: dB that `auto` may lose. Raises InputError where nothing can be followed."""
    surface, search = followed(views), 0.0
    count = None
    if budget:
        wanted, needed = parse_budget(budget), needed_points(surface, views)
        if wanted is None:
            search = 0.5
            count = fewest(surface, views, max_loss, progress=part(progress, 0, search))
        else:
            count = max(round(wanted * needed) if isinstance(wanted, float) else wanted, 1)
    most = max(FIT.least_steps, FIT.steps_a_view * len(views))
    limit = count
    if quality:
        steps, limit = min(quality.steps, most), min(count or quality.gaussians, quality.gaussians)
        count = min(limit, needed_points(surface, views))
    start = surface_tracks(surface, views, count, _settings(views))
    if not (seconds or steps) or not len(start):
        return start
    schedule = Schedule(seconds=seconds, steps=steps, max_steps=most, pyramid=(), seed=seed)
    told = part(progress, search, 1)
    warm_up("cpu")
    fitted = fit_tracks(start, views, schedule, pixel=views.pixel, progress=told)
    return fitted if not limit or len(fitted) <= limit else fitted[fitted.opacity.topk(limit).indices]


def followed(views: Views) -> SurfaceTracks:
    """The points that are followed through the clip: by the renderer, and by motion vectors where it followed nothing
    or not all. Raises InputError where nothing can be followed."""
    known = views.surface if views.surface is not None and len(views.surface) else None
    if known is not None and not views.untracked:
        return known
    if views.depth is None or views.flow is None:
        raise InputError("The views have neither surface tracks nor depth and motion vectors; render them with passes.")
    more = motion_tracks(views, known)
    if known is None:
        return more
    both = {k: np.concatenate([getattr(known, k), getattr(more, k)]) for k in vars(known)}
    order = np.random.default_rng(0).permutation(len(known) + len(more))  # so that any part of them is of both
    return SurfaceTracks(**{k: a[order] for k, a in both.items()})


def _settings(views: Views) -> TrackSettings:
    return SETTINGS if views.surface is not None and len(views.surface) else LED


def fewest(surface: SurfaceTracks, views: Views, max_loss: float, progress=None) -> int:
    """The fewest points with which a short fit comes within `max_loss` dB of one with twice as many, on views that
    neither was fitted to; as many as the pixels need, if fewer do not. Raises InputError for a loss not above 0."""
    check_loss(max_loss)
    fitted, unseen = set_aside(views)
    most, count, tried = needed_points(surface, views), FIRST_TRY, []
    schedule = Schedule(steps=TRY_STEPS, pyramid=())
    while count < most:
        told = part(progress, 1 - 0.7 ** len(tried), 1 - 0.7 ** (len(tried) + 1))
        start = surface_tracks(surface, fitted, count, _settings(views))
        tried.append(psnr(fit_tracks(start, fitted, schedule, pixel=views.pixel, progress=told), unseen))
        if len(tried) > 1 and tried[-1] - tried[-2] <= max_loss:
            return count // 2
        count *= 2
    return most
