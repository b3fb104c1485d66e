# SPDX-License-Identifier: GPL-3.0-or-later
"""The registry of metrics: a new one is one entry of METRICS, and appears in tables, CSV, metrics.json and charts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from .flip import flip
from .image_quality import psnr, psnr_foreground, ssim
from .loading import Truth
from .lpips import find_lpips

ALL, NOVEL = "", "novel_"  # prefixes of columns: over all views scored; over those alone that no input shows


@dataclass
class Pictures:
    """What a metric sees: predictions of all views, and what they should be."""

    rgb: Tensor  # (V,H,W,3) over white
    alpha: Tensor  # (V,H,W)
    truth: Truth  # of the same V views


@dataclass(frozen=True)
class Metric:
    """A figure of every view."""

    key: str  # its name in files
    title: str  # of a column in tables
    axis: str  # of an axis in charts
    digits: int  # decimals in tables
    measure: Callable[[Pictures], list[float | None]]  # a figure per view, None where there is none
    higher_is_better: bool = True
    spread: tuple[str, ...] = ()  # ALL, NOVEL: where 5th percentile and worst view are told besides the mean
    charted: bool = True  # has a panel in charts
    novel_only: bool = False  # of views that no input shows, alone, as it is dear


def _lpips(p: Pictures) -> list[float | None]:
    distance = find_lpips()
    return distance(p.rgb, p.truth.picture).tolist() if distance else [None] * len(p.rgb)


def _flip(p: Pictures) -> list[float | None]:
    novel = p.truth.novel.nonzero()[:, 0].tolist()
    found: dict[int, float] = {}
    if novel:
        errors = flip(p.rgb[novel], p.truth.picture[novel], [p.truth.features(i) for i in novel])
        found = dict(zip(novel, errors.tolist(), strict=True))
    return [found.get(i) for i in range(len(p.rgb))]


METRICS = {
    m.key: m
    for m in (
        Metric("psnr", "PSNR", "PSNR (dB)", 2, lambda p: psnr(p.rgb, p.truth.picture).tolist(), spread=(ALL, NOVEL)),
        Metric(
            "psnr_fg", "PSNR fg", "PSNR fg (dB)", 2,
            lambda p: psnr_foreground(p.rgb, p.truth.picture, p.alpha, p.truth.views.alpha).tolist(),
            spread=(ALL,), charted=False,
        ),
        Metric("ssim", "SSIM", "SSIM", 3, lambda p: ssim(p.rgb, p.truth.picture).tolist()),
        Metric("lpips", "LPIPS", "LPIPS", 3, _lpips, higher_is_better=False),
        Metric("flip", "FLIP", "FLIP", 3, _flip, higher_is_better=False, novel_only=True),
    )
}  # fmt: skip


def measure(pictures: Pictures, left_out: tuple[str, ...] = ()) -> dict[str, list]:
    """{metric: a figure per view, None where there is none or it is `left_out`}, and `novel`: whether no input shows
    the view. Six decimals."""
    nothing = [None] * len(pictures.rgb)
    frames = {k: nothing if k in left_out else m.measure(pictures) for k, m in METRICS.items()}
    frames["novel"] = pictures.truth.novel.tolist()
    return {k: [round(x, 6) if isinstance(x, float) else x for x in v] for k, v in frames.items()}


def _columns(prefix: str, m: Metric) -> list[str]:
    names = [m.key if m.novel_only else prefix + m.key]
    return names + ([f"{prefix}{m.key}_p5", f"{prefix}{m.key}_worst"] if prefix in m.spread else [])


COLUMNS = [c for m in METRICS.values() if not m.novel_only for c in _columns(ALL, m)]
COLUMNS += [c for m in METRICS.values() for c in _columns(NOVEL, m)]


def summarise(frames: dict[str, list]) -> dict[str, float | None]:
    """What `measure` gave, of the views of one object or of several -> COLUMNS: means, and 5th percentile and worst
    view; of all views and of the novel ones. None where there is nothing to average."""
    out: dict[str, float | None] = {}
    for prefix, keep in ((ALL, [True] * len(frames["novel"])), (NOVEL, frames["novel"])):
        for m in METRICS.values():
            known = [x for x, kept in zip(frames[m.key], keep, strict=True) if kept and x is not None]
            figures = [float(np.mean(known)) if known else None]
            if prefix in m.spread:
                worst = min if m.higher_is_better else max
                bad = float(np.percentile(known, 5 if m.higher_is_better else 95)) if known else None
                figures += [bad, worst(known, default=None)]
            if prefix == NOVEL or not m.novel_only:
                out |= dict(zip(_columns(prefix, m), figures, strict=True))
    return {k: out[k] for k in COLUMNS}
