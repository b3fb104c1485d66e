# SPDX-License-Identifier: GPL-3.0-or-later
"""One scene drawn and scored: views go in, a row of figures comes out."""

from __future__ import annotations

import tempfile
from importlib.util import find_spec
from pathlib import Path

import torch
from torch import Tensor

from ..datagen.sequence import InputError, Sequence
from ..model.clip import clip_of
from ..model.gaussians import DynamicScene, Gaussians4D, ReconstructedScene
from ..model.geometry.coverage import coverage
from ..model.io.ply import write_ply
from ..model.methods import METHODS, ReconstructOptions
from ..model.parallel import work_clock
from ..model.rasterize import render
from ..model.rasterize.lifetime_index import QUICKER_FROM, LifetimeIndex
from ..model.reconstruct import for_finer, reconstruct_views
from ..model.views import BACKGROUND, Views
from .loading import Truth
from .method_spec import MethodSpec
from .metrics import METRICS, Pictures, measure, summarise


def reconstruct(
    views: Views, method: MethodSpec, device: str = "cpu", seconds: float = 10.0
) -> Gaussians4D | ReconstructedScene:
    """The scene that a method makes of views (with depth and flow where it sees them), unfiltered; `seconds` for a
    method that fits the scene and names none."""
    with torch.no_grad():  # methods that fit a scene turn gradients on again
        return reconstruct_views(
            views,
            method.method,
            ReconstructOptions(
                device=device,
                checkpoint=method.checkpoint,
                seconds=method.seconds or seconds,
                refine=method.refine or 0.0,
                quality=method.quality,
                steps=method.steps,
                budget=method.budget,
                dense=method.dense,
            ),
        )


def draw(scene: Gaussians4D | ReconstructedScene, views: Views) -> tuple[Tensor, Tensor]:
    """Pictures (C,H,W,3) over white and alpha (C,H,W) of the scene from the cameras and times of views, with the
    paper's inference filters."""
    height, width = views.size
    drawn: Gaussians4D | DynamicScene = scene
    if isinstance(scene, Gaussians4D) and len(scene) > QUICKER_FROM:
        drawn = LifetimeIndex(scene)
    with torch.no_grad():
        return render(drawn, views.c2w, views.intrinsics, views.time, width, height, inference=True)


def score(scene: Gaussians4D | ReconstructedScene, truth: Truth, left_out: tuple[str, ...] = ()) -> dict[str, list]:
    """`metrics.measure` of the scene's pictures of the views of truth."""
    rgb, alpha = draw(scene, truth.views)
    if truth.inside is not None:
        share = truth.inside[..., None]
        rgb, alpha = rgb * share + BACKGROUND * (1 - share), alpha * truth.inside
    return measure(Pictures(rgb, alpha, truth), left_out)


def evaluate_views(
    views: Views, method: MethodSpec, truth: Truth, device: str = "cpu", left_out: tuple[str, ...] = ()
) -> tuple[dict, Gaussians4D | ReconstructedScene]:
    """Reconstructs from views and scores -> a row: `metrics.summarise` of the scores, which are in `frames`; seconds
    of the reconstruction and of drawing and scoring a view; how many Gaussians there are, and are kept by the
    filters. And the scene, of those kept, on the processor."""
    start = work_clock()
    scene = reconstruct(views, method, device)
    kept = scene[scene.alive()]
    taken = work_clock() - start
    frames = score(kept, truth, left_out)
    each = (work_clock() - start - taken) / len(truth.picture)
    row = {"seconds": taken, "seconds_scoring": each, "gaussians": len(scene), "gaussians_kept": len(kept)}
    return summarise(frames) | row | {"frames": frames}, kept


def psnr_of_finer(scene: Gaussians4D | ReconstructedScene, views: Views, truth: Truth) -> float:
    """Mean PSNR over the pictures of truth, which may be finer than the views that the scene was fitted to."""
    finer = for_finer(scene, max(truth.views.size) / max(views.size), views.pixel)
    frames = score(finer, truth, left_out=tuple(k for k in METRICS if k != "psnr"))
    return sum(frames["psnr"]) / len(frames["psnr"])


COSTS = ("ply_mb", "usd_mb", "render_ms", "coverage")


def costs(
    scene: Gaussians4D | ReconstructedScene, views: Views, truth: Truth, method: MethodSpec, seq: Sequence
) -> dict:
    """COSTS: megabytes of the scene as .ply and, where pxr is installed, as .usdc (None of a scene that no asset can
    hold); milliseconds to draw a view; the share of the object that the input views show, where it can be told."""
    start = work_clock()
    draw(scene, truth.views)
    drawing = 1000 * (work_clock() - start) / len(truth.picture)
    known = METHODS[method.method].knows_surface and not (method.fitted or method.dense)
    sizes = megabytes(scene, seq)
    covered = coverage(scene, views)[0] if known and isinstance(scene, Gaussians4D) else None
    return dict(zip(COSTS, (*sizes, drawing, covered), strict=True))


def megabytes(scene: Gaussians4D | ReconstructedScene, seq: Sequence) -> tuple[float | None, float | None]:
    """Of the scene as .ply and, where pxr is installed, as .usdc; None of what no asset can hold."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        ply, usd = Path(folder) / "a.ply", Path(folder) / "a.usdc"
        try:
            asset = scene.to_asset(clip_of(seq))
        except InputError:
            return None, None
        write_ply(ply, asset)
        if find_spec("pxr"):
            from ..model.io.usd_write import write_usd

            write_usd(usd, asset)
        return ply.stat().st_size / 1e6, usd.stat().st_size / 1e6 if usd.exists() else None
