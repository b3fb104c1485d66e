# SPDX-License-Identifier: GPL-3.0-or-later
"""What the network is measured against, each from the same Views and through the same evaluator. Importing this adds
them to `model.methods`.

`visual_hull.py` costs nothing (`white`, `hull`); `gs_lrm.py` is a network that knows no time; `four_dgs.py` and
`shape_of_motion.py` fit one scene at a time, on the loop of `model/fitting/loop.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from ..devices import fitting_device
from ..methods import Method, Progress, ReconstructOptions, load_predictor, register
from ..views import Views
from . import four_dgs, gs_lrm, shape_of_motion, visual_hull


def _at_once(reconstruct: Callable, views: Views, options: ReconstructOptions, progress: Progress | None):
    return reconstruct(views)


def _static(reconstruct: Callable, views: Views, options: ReconstructOptions, progress: Progress | None):
    """`reconstruct` of gs_lrm.py, with the network that was trained without time."""
    return reconstruct(views, load_predictor(options))


def _fitted(fit: Callable, views: Views, options: ReconstructOptions, progress: Progress | None):
    how: dict = {"steps": options.steps, "seed": options.seed, "progress": progress}
    if quality := options.named_quality:
        how |= {"steps": quality.steps, "max_gaussians": quality.gaussians}
    return fit(views, fitting_device(options.device), options.seconds, **how)


register(
    Method("white", "reference: the empty picture", partial(_at_once, visual_hull.white), baseline=True),
    Method(
        "hull",
        "reference: visual hull in the object's mean colour (RGB and alpha)",
        partial(_at_once, visual_hull.visual_hull),
        baseline=True,
    ),
    Method(
        "gs-lrm-frame",
        "after GS-LRM: our network trained without time, each frame from its own views alone",
        partial(_static, gs_lrm.per_frame),
        baseline=True,
        checkpoint="static",
    ),
    Method(
        "gs-lrm-all",
        "after GS-LRM: our network trained without time, all views taken for one moment",
        partial(_static, gs_lrm.all_in),
        baseline=True,
        checkpoint="static",
    ),
    Method(
        "4dgs",
        "after 4DGS: 4D Gaussians fitted to the views from random points, for some seconds",
        partial(_fitted, four_dgs.four_dgs),
        fits=True,
        baseline=True,
    ),
    Method(
        "som",
        "after Shape of Motion: one cloud and a few rigid motions fitted to the views, from swept depths, no tracks",
        partial(_fitted, shape_of_motion.shape_of_motion),
        fits=True,
        baseline=True,
    ),
)
