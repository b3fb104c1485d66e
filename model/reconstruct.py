# SPDX-License-Identifier: GPL-3.0-or-later
"""From a Sequence to Gaussians4D by a named method, refined and within a budget where that is asked for."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch

from ..datagen.sequence import InputError, Sequence
from .checkpoints_io import CHECKPOINTS
from .devices import fitting_device
from .gaussians import Gaussians4D, ReconstructedScene
from .methods import Method, Progress, ReconstructOptions, method_named
from .tracks import Tracks4D
from .views import Views, load_views, shrink

DEFAULTS = ReconstructOptions()
FOLLOWED = 4  # views of a time, see `default_method`
Scene = Gaussians4D | ReconstructedScene


def default_method(sequence: Sequence, indices=None) -> str:
    """What suits what was rendered: tracks where surfaces were followed; else flow where there is depth, but where the
    renderer found nothing that it could follow, as of a metaball whose surface comes and goes, only if FOLLOWED views
    show a time: from fewer the network's Gaussians are the better ones; of pictures alone deform."""
    views = sequence.views if indices is None else [sequence.views[i] for i in indices]
    if not all(v.passes for v in views):
        return "deform"
    if sequence.tracks:
        return "tracks"
    few = len(views) < FOLLOWED * len({v.frame for v in views})
    return "guided" if sequence.untracked and few else "flow"


def chosen_method(sequence: Sequence, asked: str | None, indices=None) -> str:
    """What was asked for, or `default_method`; this too in place of tracks where the renderer found nothing that it
    could follow."""
    nothing = asked == "tracks" and not sequence.tracks and bool(sequence.untracked)
    return default_method(sequence, indices) if nothing or not asked else asked


def untracked_note(sequence: Sequence) -> str:
    """What is to be said of objects whose surfaces could not be followed; nothing where there are none."""
    names = ", ".join(sequence.untracked[:4]) + (" and others" if len(sequence.untracked) > 4 else "")
    return f"{names}: the surface could not be followed, motion vectors lead it" if names else ""


def reconstruct(
    sequence: Sequence,
    method: str | None = None,
    indices=None,
    options: ReconstructOptions = DEFAULTS,
    progress: Progress | None = None,
    size: int | None = None,
) -> Scene:
    """Views `indices` of the Sequence (all of them by default), at `size` pixels (see `load_views`), by a method
    (`default_method` where none is named) -> the scene (N,), Gaussians filtered out that the paper's inference filters
    would never draw. `progress(fraction, text)` is called between steps.

    Raises InputError for an unknown method, missing passes, a damaged image or checkpoint, a size that is no whole
    fraction, and a device that cannot be used."""
    report = progress or (lambda fraction, text: None)
    method = chosen_method(sequence, method, indices)
    has_depth = method_named(method).has_depth
    report(0.0, "reading views")
    indices = range(len(sequence.views)) if indices is None else indices
    views = load_views(sequence, indices, has_depth, size)
    if not (views.alpha > 0.5).any():
        raise InputError(f"{sequence.root}: no view shows the object; check the cameras and the alpha channel.")
    report(0.3, f"reconstructing ({method})")
    with torch.inference_mode():
        fit = progress and (lambda fraction, text: report(0.3 + 0.7 * fraction, text))
        g = reconstruct_views(views, method, options, fit)
    return g[g.alive()]


def reconstruct_views(
    views: Views, method: str, options: ReconstructOptions = DEFAULTS, progress: Progress | None = None
) -> Scene:
    """The same from tensors; unfiltered. `progress(fraction, text)` is called by what takes seconds."""
    quality = options.named_quality
    by = -(-max(views.size) // quality.size) if quality else 1
    return _from_smaller(views, by, lambda smaller: _reconstruct(smaller, method, options, progress))


def _from_smaller(views: Views, by: int, run: Callable[[Views], Scene]) -> Scene:
    """What `run` makes of the views at 1/by of their size, to be drawn at their own."""
    return for_finer(run(shrink(views, by)), by, by * views.pixel)


def for_finer(scene: Scene, by: float, pixel: float) -> Scene:
    """A scene that was fitted to pictures whose pixels have this size at the object, as it is to be drawn in pictures
    `by` times as fine: there it would be less blurred by the rasteriser, a part of a pixel, than it was fitted."""
    if by > 1 and isinstance(scene, Gaussians4D | Tracks4D):
        from .rasterize.constants import BLUR

        return scene.widened(math.sqrt(BLUR * (1 - by**-2)) * pixel)
    return scene


def _run(chosen: Method, views: Views, options: ReconstructOptions, progress: Progress | None) -> Scene:
    """The method over the views, made smaller where they show more than it can make a Gaussian of each pixel of."""
    shown = float((views.alpha > 0).sum())
    by = math.ceil(math.sqrt(shown / chosen.most_pixels)) if chosen.most_pixels and shown else 1
    if by > 1 and progress:
        progress(0.0, f"{chosen.name} from pictures at 1/{by} of their size")
    return _from_smaller(views, by, lambda smaller: chosen.run(smaller, options, progress))


def _reconstruct(views: Views, method: str, options: ReconstructOptions, progress: Progress | None) -> Scene:
    chosen = method_named(method)
    if chosen.checkpoint and not options.checkpoint:
        options = replace(options, checkpoint=CHECKPOINTS / f"{chosen.checkpoint}.safetensors")
    counted = options.counted and not chosen.fits  # those that fit a scene have taken these steps by then
    if chosen.budgets or not (options.refine or options.budget or counted):
        return _run(chosen, views, options, progress)

    from .fitting.budget import apply_budget
    from .fitting.refine import Few, refine, start_size

    device = fitting_device(options.device)
    # What is merged into a few thousand Gaussians may start from small pictures, in a quarter of the time.
    as_given = chosen.has_depth or chosen.fits or "%" in (options.budget or "")
    start = _run(chosen, views if as_given else start_size(views), options, None)
    told = {"has_depth": chosen.has_depth, "device": device, "seed": options.seed, "progress": progress}
    told["steps"], most = options.steps, None
    if quality := options.named_quality:
        few = Few.of(chosen.has_depth)
        told["steps"] = min(quality.steps, few.max_steps)
        most = min(quality.gaussians, few.limit(views)) if len(start) > quality.gaussians else None
    if options.budget:
        return apply_budget(start, views, options.budget, options.refine, max_loss=options.max_loss, **told)
    return refine(start, views, options.refine, max_gaussians=most, **told)
