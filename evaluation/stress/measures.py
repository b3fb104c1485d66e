# SPDX-License-Identifier: GPL-3.0-or-later
"""What the stress suite measures beside pictures' likeness: ghosts and how old they are, flicker, and times between
those that inputs show."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ...datagen.zoo.trials import BETWEEN
from ..image_quality import psnr
from ..metrics import Pictures, measure, summarise
from .scenes import Scene

EMPTY = 1 / 255  # alpha below which nothing is there
SHOWN = 0.05  # of a ghost's alpha, or it has no age


@dataclass(frozen=True)
class Measure:
    """A column of stress.csv."""

    key: str
    title: str  # in tables
    digits: int


MEASURES = {
    m.key: m
    for m in (
        Measure("psnr", "PSNR", 2),
        Measure("psnr_p5", "5 %", 2),
        Measure("psnr_worst", "worst", 2),
        Measure("ssim", "SSIM", 3),
        Measure("flip", "FLIP", 3),
        Measure("flip_p95", "FLIP 95 %", 3),
        Measure("flip_worst", "FLIP worst", 3),
        Measure("between", "PSNR between", 2),
        Measure("between_worst", "worst between", 2),
        Measure("at_whole", "PSNR at whole", 2),
        Measure("ghost", "ghost %", 2),
        Measure("ghost_age", "ghost age", 1),
        Measure("flicker", "flicker", 2),
        Measure("gaussians", "Gaussians", 0),
        Measure("seconds", "seconds", 1),
    )
}


def measured(moments: tuple[Tensor, Tensor], watch: tuple[Tensor, Tensor], scene: Scene) -> tuple[dict, int]:
    """Pictures (rgb over white (V,H,W,3), alpha (V,H,W)) of the views of `scene.moments` and of `scene.watch` ->
    figures by the names of MEASURES, and the number of the worst view of `moments`.

    psnr, ssim, flip of all whole moments; of the camera that stands still: `between` at the quarters between moments,
    `at_whole` at the moments, `ghost` (see `ghosts`) and `flicker` (see `flicker`) at the moments."""
    frames = measure(Pictures(*moments, scene.moments), ("lpips", "psnr_fg"))
    whole = summarise(frames)
    found = {k: whole[k] for k in ("psnr", "psnr_p5", "psnr_worst", "ssim", "flip")}
    found |= {"flip_p95": float(np.percentile(frames["flip"], 95)), "flip_worst": max(frames["flip"])}
    each = psnr(watch[0], scene.watch.picture)
    at_whole = torch.arange(len(each)) % BETWEEN == 0
    found |= {"between": float(each[~at_whole].mean()), "between_worst": float(each[~at_whole].min())}
    found |= {"at_whole": float(each[at_whole].mean())}
    found["ghost"], found["ghost_age"] = ghosts(watch[1][at_whole], scene.watch.views.alpha[at_whole])
    found["flicker"] = flicker(watch[0][at_whole], scene.watch.picture[at_whole])
    return found, int(np.argmin(frames["psnr"]))


def ghosts(alpha: Tensor, truth: Tensor) -> tuple[float, float]:
    """Alpha (T,H,W) of what is shown where the truth is empty, as a percentage of all that there is in truth; and how
    old it is, in moments: of each ghostly pixel the time to the nearest moment, before or after, at which something is
    there in truth, weighted by alpha; NaN where there is no ghost, or of what never was there."""
    empty = truth < EMPTY
    ghost = torch.where(empty, alpha, 0.0)
    share = 100 * float(ghost.sum() / truth.sum().clamp_min(1))
    count = len(alpha)
    apart = (torch.arange(count)[:, None] - torch.arange(count)[None]).abs().float()
    # (T,T,…): moments to each moment at which a pixel is covered
    age = torch.stack([torch.where(empty, torch.inf, apart[t][:, None, None]).amin(0) for t in range(count)])
    weight = torch.where(torch.isfinite(age) & (ghost > SHOWN), ghost, 0.0)
    total = float(weight.sum())
    old = float((weight * torch.where(torch.isfinite(age), age, 0.0)).sum()) / total if total else float("nan")
    return share, old


def flicker(rgb: Tensor, truth: Tensor) -> float:
    """(T,H,W,3) both: the mean error of the change from one moment to the next, in 255ths, over what either shows."""
    error = (rgb.clamp(0, 1).diff(dim=0) - truth.diff(dim=0)).abs().mean(-1)
    shown = ((rgb < 1) | (truth < 1)).any(-1)
    shown = shown[1:] | shown[:-1]
    return 255 * float(error[shown].mean()) if shown.any() else 0.0


def lost(levels: list[float], values: list[float], by: float = 3.0) -> float | None:
    """The level at which so much of the first value is lost, between levels by a straight line; None where it never
    is."""
    for (a, va), (b, vb) in zip(
        zip(levels, values, strict=True), zip(levels[1:], values[1:], strict=True), strict=False
    ):
        if values[0] - vb >= by:
            share = (va - (values[0] - by)) / (va - vb)
            return a + share * (b - a)
    return None
