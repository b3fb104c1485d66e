# SPDX-License-Identifier: GPL-3.0-or-later
"""What of an asset changes over time, as USD samples it: {time code: array}, as few samples as say it. numpy only."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from ...datagen.sequence import InputError
from .asset import VISIBLE, Asset, rotation_matrices

MAX_STRAY = 5.0  # how far, in normalised units, an invisible point may be before positions are sampled per frame
HOLD_SIGMAS = 4.0  # lifetimes after which a Gaussian stands still: exp(-½·4²) rounds to an opacity of 0
EXTENT_SIGMAS = 3.0
STRAIGHT = 1e-5  # by which a path may leave its chord, in normalised units, to be written as its two ends
PARTS = 4  # that frames are cut into at the most, where straight lines from one to the next are too far from paths …
BESIDE = 0.5  # … which is by so many σ of a Gaussian …
FEW = 1e-3  # … for more than this share of what is there


def positions(asset: Asset, every: bool, path: Path) -> dict[float, np.ndarray]:
    """{time code: (N,3)}: one sample if nothing moves, two if all go straight and no line leaves the box, else (or if
    `every`) one a frame; unless `every`, two or PARTS where paths bend much between two frames. Raises InputError,
    which names `path`, where they overflow."""
    samples = _of_lines(asset, every) if asset.paths is None else _of_paths(asset, every)
    if not all(np.isfinite(p).all() for p in samples.values()):
        raise InputError(f"{path}: velocity is so large that positions overflow; reconstruct it again.")
    return samples


def _of_paths(asset: Asset, every: bool) -> dict[float, np.ndarray]:
    with np.errstate(over="ignore", invalid="ignore"):
        samples = {float(f): asset.at(asset.frame_to_time(f))[0] for f in asset.clip.frames}
        (start, first), (end, last) = (list(samples.items())[i] for i in (0, -1))
        if all(np.array_equal(first, p) for p in samples.values()):
            return {start: first}
        chords = ((p, first + np.float32((f - start) / (end - start)) * (last - first)) for f, p in samples.items())
        if not every and all((np.abs(p - q) < STRAIGHT).all() for p, q in chords):
            return {start: first, end: last}
        return samples if every else _with_bends(asset, samples)


def _with_bends(asset: Asset, samples: dict[float, np.ndarray]) -> dict[float, np.ndarray]:
    """The samples of all frames, and of as many between as paths need."""
    size, found = asset.soft_scale().max(1), dict[float, np.ndarray]()
    for (code, a), b in zip(samples.items(), list(samples.values())[1:], strict=False):
        here = {s: asset.at(asset.frame_to_time(code + s))[0] for s in (np.arange(1, PARTS) / PARTS).tolist()}
        here |= {0.0: a, 1.0: b}
        seen = asset.at(asset.frame_to_time(code + 0.5))[1] >= VISIBLE
        parts = 1
        while parts < PARTS and _beside(here, parts, seen, size) > FEW:
            parts *= 2
        found |= {code + i / parts: here[i / parts] for i in range(parts)}
    return found | {code + 1.0: b}


def _beside(here: dict[float, np.ndarray], parts: int, seen: np.ndarray, size: np.ndarray) -> float:
    """The share of those seen (N,) whose places `here`, {part of a frame: (N,3)}, are more than BESIDE of their size
    (N,) from straight lines between every 1/`parts` of a frame."""
    far = np.zeros(len(size), bool)
    for s, place in here.items():
        before = min(np.floor(s * parts), parts - 1) / parts
        line = here[before] + np.float32((s - before) * parts) * (here[before + 1 / parts] - here[before])
        far |= np.linalg.norm(place - line, axis=1) > BESIDE * size
    return float(far[seen].mean()) if seen.any() else 0.0


def _of_lines(asset: Asset, every: bool) -> dict[float, np.ndarray]:
    clip = asset.clip

    def held(time: float) -> np.ndarray:
        dt = np.clip(np.float32(time) - asset.t, -HOLD_SIGMAS * asset.sigma_t, HOLD_SIGMAS * asset.sigma_t)
        return asset.xyz + asset.velocity * dt[:, None]

    if clip.frame_start == clip.frame_end or not asset.velocity.any():
        return {float(clip.frame_start): asset.at(0.0)[0] if asset.velocity.any() else asset.xyz}
    with np.errstate(over="ignore", invalid="ignore"):
        ends = {float(f): asset.at(t)[0] for f, t in ((clip.frame_start, -1.0), (clip.frame_end, 1.0))}
        astray = [(np.abs(p) > MAX_STRAY) & (p != held(t)) for p, t in zip(ends.values(), (-1, 1), strict=True)]
        if every or any(a.any() for a in astray):
            return {float(f): held(asset.frame_to_time(f)) for f in clip.frames}
    return ends


def orientations(asset: Asset, codes: Iterable[float] = ()) -> dict[float, np.ndarray]:
    """{time code: (N,4)}: one sample if nothing turns, else one a frame and at each of these time codes, from each to
    the next the shorter way."""
    first = asset.clip.frame_start
    if asset.paths is None:
        return {float(first): asset.rotation}
    samples = {float(first): asset.rotation_at(asset.frame_to_time(first))}
    last = samples[float(first)]
    for code in sorted({*map(float, asset.clip.frames), *codes} - {float(first)}):
        turned = asset.rotation_at(asset.frame_to_time(code))
        last = np.where((turned * last).sum(1, keepdims=True) >= 0, turned, -turned)
        samples[code] = last
    still = all(np.array_equal(samples[first], q) for q in samples.values())
    return {float(first): asset.rotation} if still else samples


def widths(asset: Asset, curve: dict[float, np.ndarray]) -> dict[float, np.ndarray]:
    """Diameters for readers of points: twice the middle standard deviation, which covers a flat splat's
    face, rounded to 256 steps of its logarithm (few values make a small file); 0 while invisible."""
    middle = np.log(np.sort(asset.soft_scale(), axis=1)[:, 1])
    step = max((middle.max() - middle.min()) / 255, 1e-9)
    width = 2 * np.exp(np.round((middle - middle.min()) / step) * step + middle.min())
    return {code: np.where(o >= VISIBLE, width, 0).astype(np.float32) for code, o in curve.items()}


def extent_of(asset: Asset) -> np.ndarray:
    """(2,3) bounds of all Gaussians (three sigmas) at the frames where they are visible; of all of them at
    their own times if none ever is."""
    reach = _reach(asset, asset.rotation)
    low, high = [], []
    for frame in asset.clip.frames:
        time = asset.frame_to_time(frame)
        position, opacity = asset.at(time)
        if asset.paths is not None:
            reach = _reach(asset, asset.rotation_at(time))
        seen = opacity >= VISIBLE
        if seen.any():
            low.append((position - reach)[seen].min(0))
            high.append((position + reach)[seen].max(0))
    if not low:
        reach = _reach(asset, asset.rotation)
        return np.stack([(asset.xyz - reach).min(0), (asset.xyz + reach).max(0)])
    return np.stack([np.min(low, 0), np.max(high, 0)])


def _reach(asset: Asset, rotation: np.ndarray) -> np.ndarray:
    """(N,3) half the sides of the boxes around the Gaussians that are turned like this (N,4)."""
    M = rotation_matrices(rotation) * asset.soft_scale()[:, None, :]
    return EXTENT_SIGMAS * np.sqrt((M**2).sum(-1))
