# SPDX-License-Identifier: GPL-3.0-or-later
"""The ways from Views to a scene, by name: what each is, what it needs, and how it is run.

The product's own are here. Those that it is compared with add themselves when `model.baselines` is imported.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from ..datagen.sequence import InputError
from .fitting.quality import Quality, quality_named
from .gaussians import Gaussians4D, ReconstructedScene
from .views import Views


@dataclass(frozen=True)
class ReconstructOptions:
    """How a scene is reconstructed. Raises InputError for seconds, steps, qualities and budgets that are none, and for
    more than one of quality, steps and refine."""

    device: str = "cpu"  # of networks, as torch names it; fits take the processor where it has no rasteriser
    checkpoint: Path | None = None  # weights in place of the shipped ones
    seconds: float = 10.0  # that methods which fit a scene may take
    refine: float = 0.0  # seconds for which the result is then fitted to the views
    quality: str | None = None  # a name of QUALITIES, which says how much is fitted, in place of seconds
    steps: int | None = None  # exactly so many of the method's own fit, or of refinement where it has none; likewise
    budget: str | None = None  # most Gaussians: "N", "P%" or "auto"
    max_loss: float = 0.1  # dB that "auto" may lose
    dense: bool = False  # a network's tokens everywhere, and not only where the object is
    seed: int = 0  # of all that is random in fits

    def __post_init__(self):
        asked = {"quality": self.quality, "steps": self.steps is not None, "refine": self.refine}
        if len(both := [k for k, v in asked.items() if v]) > 1:
            raise InputError(f"{' and '.join(both)}: each says how long a fit goes on; give one of them.")
        if self.quality:
            quality_named(self.quality)
        if self.steps is not None and self.steps < 1:
            raise InputError(f"{self.steps} steps: give 1 or more.")
        if self.refine or self.budget:  # refuse now what else is found out after seconds
            from .fitting.budget import parse_budget
            from .fitting.refine import check_seconds

            check_seconds(self.refine)
            if self.budget:
                parse_budget(self.budget)

    @property
    def named_quality(self) -> Quality | None:
        return quality_named(self.quality) if self.quality else None

    @property
    def counted(self) -> bool:
        """Whether fits go by steps, and so come out the same whatever the machine does beside."""
        return bool(self.quality) or self.steps is not None


Progress = Callable[[float, str], None]  # fraction 0..1, what is done


@dataclass(frozen=True)
class Method:
    """One way from Views to a scene."""

    name: str
    about: str  # what it is and whose
    # (views, options, progress): views of the quality's size, options.checkpoint is what to load, progress is called by
    # what takes seconds
    run: Callable[[Views, ReconstructOptions, Progress | None], Gaussians4D | ReconstructedScene]
    has_depth: bool = False  # sees depth and motion vectors; else RGB and alpha alone
    fits: bool = False  # to the scene, for some seconds or steps
    baseline: bool = False  # what the product is compared with
    budgets: bool = False  # keeps within options.budget itself
    checkpoint: str | None = None  # name of the shipped weights that it loads
    quality: str | None = None  # that is meant where nothing says how long it shall fit, in place of seconds
    knows_surface: bool = False  # its Gaussians know which way their surface faces
    most_pixels: int | None = None  # that show the object, of all views; from smaller pictures where there are more


METHODS: dict[str, Method] = {}


def register(*methods: Method) -> None:
    """Adds methods to METHODS."""
    METHODS.update({m.name: m for m in methods})


def method_named(name: str) -> Method:
    """Raises InputError where there is none of this name."""
    if name not in METHODS:
        raise InputError(f"{name}: no such method; choose one of {', '.join(METHODS)}.")
    return METHODS[name]


def run_lift(views: Views, options: ReconstructOptions, progress: Progress | None) -> Gaussians4D:
    from .geometry.lift import lift

    return lift(views)


def run_tracks(views: Views, options: ReconstructOptions, progress: Progress | None) -> ReconstructedScene:
    from .fitting.track_views import reconstruct_tracks

    seconds = options.refine or options.seconds
    told = {"budget": options.budget, "max_loss": options.max_loss, "seed": options.seed, "progress": progress}
    return reconstruct_tracks(views, seconds, steps=options.steps, quality=options.named_quality, **told)


def run_flow(views: Views, options: ReconstructOptions, progress: Progress | None) -> ReconstructedScene:
    return run_tracks(replace(views, surface=None, untracked=False), options, progress)


def run_deform(views: Views, options: ReconstructOptions, progress: Progress | None) -> ReconstructedScene:
    from .deformation.fit import reconstruct_deform

    seconds = options.refine or options.seconds
    told = {"budget": options.budget, "max_loss": options.max_loss, "seed": options.seed, "progress": progress}
    return reconstruct_deform(views, seconds, steps=options.steps, quality=options.named_quality, **told)


def load_predictor(options: ReconstructOptions) -> Callable[..., Gaussians4D]:
    """The network of options.checkpoint, from Views (and `progress`) to Gaussians. Raises InputError as `load_network`
    does."""
    from .checkpoints_io import load_network
    from .inference import apply_network

    network = load_network(options.checkpoint, options.device)
    return partial(apply_network, network, device=options.device, drop_empty=not options.dense)


def run_network(views: Views, options: ReconstructOptions, progress: Progress | None) -> Gaussians4D:
    return load_predictor(options)(views, progress=progress)


SWEPT = 1_500_000  # pixels, each of which becomes a Gaussian; of 1.1 million, in 800² pictures: 43 s, 4.6 GB, two cores


register(
    Method(
        "tracks",
        "ours: surface points followed through the clip, whose looks all views share, fitted",
        run_tracks,
        has_depth=True,
        fits=True,
        budgets=True,
    ),
    Method(
        "flow",
        "ours: points that depth and motion vectors lead, whatever the renderer followed, likewise",
        run_flow,
        has_depth=True,
        fits=True,
        budgets=True,
    ),
    Method(
        "lift",
        "ours: depth and motion vectors to Gaussians, no network",
        run_lift,
        has_depth=True,
        knows_surface=True,
    ),
    Method(
        "guided",
        "ours: the network over depth and motion vectors",
        run_network,
        has_depth=True,
        checkpoint="guided",
        knows_surface=True,
    ),
    Method(
        "rgb",
        "ours: the network over RGB alone: the better of `sweep` and `predicted` on held-out objects",
        run_network,
        checkpoint="sweep",
        knows_surface=True,
        most_pixels=SWEPT,
    ),
    Method(
        "sweep",
        "ours: the network over RGB with depths swept from the other views",
        run_network,
        checkpoint="sweep",
        knows_surface=True,
        most_pixels=SWEPT,
    ),
    Method(
        "deform",
        "ours: one cloud moved by control points, both fitted to RGB alone; as tracks",
        run_deform,
        fits=True,
        budgets=True,
        quality="balanced",  # ten seconds are too few, and the 800 pixels of many data sets more than it needs
    ),
    Method(
        "predicted",
        "the paper's network over RGB, token dropping on",
        run_network,
        baseline=True,
        checkpoint="predicted",
    ),
)
