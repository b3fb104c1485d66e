# SPDX-License-Identifier: GPL-3.0-or-later
"""No more Gaussians than a scene needs, out of a fit that has as many as its pixels are worth: halved, those that show
least first, for as long as the views that are left out of it do not tell."""

from __future__ import annotations

import math
from dataclasses import replace

from ..fitting.budget import check_loss
from ..fitting.fit_tracks import fit_tracks
from ..fitting.fit_views import psnr, set_aside, validation_views
from ..fitting.loop import Schedule
from ..fitting.merge import contribution
from ..fitting.refine import part
from ..tracks import Tracks4D
from ..views import Views

STEPS = 150  # of the looks of what is left, each time
LOOKED_AT = 24  # views, at the most, by which it is known how much each shows
FEWEST = 8


def thinned(tracks: Tracks4D, views: Views, max_loss: float, progress=None) -> Tracks4D:
    """The tracks (N,) of a fit to detached views -> as few of them as keep within `max_loss` dB of all, their looks
    fitted anew; to be called inside of `gradients()`. For `progress` see `optimise`. Raises InputError for a loss not
    above 0."""
    check_loss(max_loss)
    (fitted, unseen), pixel = set_aside(views), views.pixel
    some = fitted[validation_views(fitted, min(LOOKED_AT, len(fitted)))]

    def fit(start: Tracks4D, tried: int) -> tuple[Tracks4D, float]:
        told = part(progress, 1 - 0.7**tried, 1 - 0.7 ** (tried + 1))
        done = fit_tracks(start, fitted, Schedule(steps=STEPS, pyramid=()), pixel=pixel, progress=told)
        return done, psnr(done, unseen)

    best, enough = tracks, None
    for tried in range(64):
        fewer = best
        if tried:
            most = contribution(best, some).topk(len(best) // 2).indices
            fewer = best[most]
            # Each stands for what was two: on a surface, as wide as both together.
            fewer = replace(fewer, scale=fewer.scale * math.sqrt(2))
        done, quality = fit(fewer, tried)
        enough = quality - max_loss if enough is None else enough
        if quality < enough or (tried and len(done) < FEWEST):
            return best
        best = done
    return best
