# SPDX-License-Identifier: GPL-3.0-or-later
"""Films of an asset, drawn by our own rasteriser: a turntable that plays while it turns, or what cameras see; as .mp4
(PyAV), animated .webp, or a folder of pictures with alpha. `timesplat video`; for Blender, the worker asks."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from ..datagen.rigs import Shot, spherical
from ..datagen.sequence import InputError, Normalisation, focal_from_fov, opengl_to_opencv
from .gaussians import Gaussians4D
from .io.asset import SCREEN_BLUR, Asset
from .io.atomic import atomic_write, new_folder
from .io.page import FOV, MARGIN, bounds
from .rasterize.render import render
from .tracks import Tracks4D

SUFFIXES = (".mp4", ".webp", "")  # "": a folder of .png
LONGEST_SIDE = 8192  # pixels
MOST_FRAMES = 20_000
TURN_SECONDS = 4.0  # that a turntable takes at least
STILL_SECONDS = 4.0  # of the turn of what does not move
ELEVATION = 15.0  # degrees
MOST_SAMPLES = 4  # along each side of a pixel
QUALITY = {"crf": "16", "preset": "medium"}  # of H.264: hard to tell from the picture itself
WEBP_QUALITY = 85
Progress = Callable[[float, str], None]


@dataclass(frozen=True)
class Look:
    """How a film is drawn. background: (3,) sRGB-encoded in 0..1, or None: transparent."""

    width: int = 512
    height: int = 512
    fps: float = 24.0
    background: tuple[float, float, float] | None = (1.0, 1.0, 1.0)


def turntable(asset: Asset, fps: float, plays: int | None = None) -> list[Shot]:
    """Cameras in the asset's normalised space that go once around it while its clip plays `plays` times, by default as
    often as takes TURN_SECONDS; with another rate than the clip's, at fractional frames."""
    clip = asset.clip
    target, radius = bounds(asset)
    long = clip.frame_end - clip.frame_start + 1
    each = max(round(long * fps / clip.fps), 1)  # pictures that a play takes
    if long == 1:
        plays, each = plays or 1, max(round(STILL_SECONDS * fps), 1)
    plays = plays or math.ceil(TURN_SECONDS * fps / each)
    shots = []
    for i in range(plays * each):
        c2w = spherical(360 * i / (plays * each), ELEVATION, MARGIN * radius / math.sin(math.radians(FOV / 2)))
        c2w[:3, 3] += target
        frame = clip.frame_start + (i % each) * clip.fps / fps if long > 1 else clip.frame_start
        shots.append(Shot(min(frame, clip.frame_end), "turntable", "turntable", c2w, FOV))
    return shots


def placed(shots: list[Shot], asset: Asset) -> list[Shot]:
    """Cameras in the world -> in the asset's normalised space."""
    lie = Normalisation(asset.clip.scale, asset.clip.translation)
    return [replace(s, c2w=lie.from_world(s.c2w)) for s in shots]


def pictures(asset: Asset, shots: list[Shot], look: Look) -> Iterator[np.ndarray]:
    """What each of the shots (normalised space) shows, (height,width,4) uint8: over the background, or with straight
    alpha. Gaussians look as in the pictures that they were fitted to, at whatever size they are drawn."""
    several, (target, _) = max(torch.get_num_threads(), 1), bounds(asset)
    for first in range(0, len(shots), several):
        yield from _drawn(asset, target, shots[first : first + several], look)


def _drawn(asset: Asset, target: list[float], shots: list[Shot], look: Look) -> Iterator[np.ndarray]:
    clip, longer = asset.clip, max(look.width, look.height)
    c2w = np.stack([opengl_to_opencv(np.asarray(s.c2w, np.float64)) for s in shots])
    away = float(np.median(np.linalg.norm(c2w[:, :3, 3] - target, axis=1)))
    pixel = away * 2 * math.tan(math.radians(shots[0].fov) / 2) / longer  # of the film, at the asset
    samples = min(math.ceil(pixel / clip.pixel - 0.2), MOST_SAMPLES) if clip.pixel else 1
    samples = max(samples, 1)
    missing = max(clip.pixel**2 - (pixel / samples) ** 2, 0)  # of the blur that the fit saw, what the film's lacks
    soft = replace(asset, scale=np.hypot(asset.scale, np.float32(math.sqrt(SCREEN_BLUR * missing))))
    scene = Gaussians4D.from_asset(soft) if soft.paths is None else Tracks4D.from_asset(soft)
    width, height, side = look.width * samples, look.height * samples, longer * samples
    intrinsics = []
    for s in shots:
        focal = focal_from_fov(s.fov, side)
        intrinsics.append([focal, focal, width / 2 - s.shift[0] * side, height / 2 + s.shift[1] * side])
    times = [clip.frame_to_time(min(max(s.frame, clip.frame_start), clip.frame_end)) for s in shots]
    with torch.no_grad():
        rgb, alpha = render(
            scene,
            torch.from_numpy(c2w.astype(np.float32)),
            torch.tensor(intrinsics, dtype=torch.float32),
            torch.tensor(np.array(times), dtype=torch.float32),
            width,
            height,
            background=0.0,
            inference=True,
        )
    both = torch.cat([rgb, alpha[..., None]], -1).clamp(0, 1)
    both = both.reshape(len(shots), look.height, samples, look.width, samples, 4).mean((2, 4)).numpy()
    if look.background is None:
        both[..., :3] /= np.maximum(both[..., 3:], 1e-6)
    else:
        both[..., :3] += (1 - both[..., 3:]) * np.array(look.background, np.float32)
        both[..., 3] = 1
    yield from np.round(both.clip(0, 1) * 255).astype(np.uint8)


# ---------------------------------------------------------------- files


def write_film(path: Path, asset: Asset, shots: list[Shot], look: Look, progress: Progress | None = None) -> int:
    """Draws the shots (normalised space) into an .mp4, an animated .webp, or, where the name has no suffix, a new
    folder with a .png each; whole or not at all. Returns their number. Raises InputError, also without PyAV."""
    check_look(path, look)
    if not 0 < len(shots) <= MOST_FRAMES:
        raise InputError(f"{path}: a film of {len(shots)} pictures; 1 to {MOST_FRAMES:,} can be made.")
    with _writer(path, look, len(shots)) as add:
        for i, picture in enumerate(pictures(asset, shots, look)):
            add(picture)
            if progress:
                progress((i + 1) / len(shots), f"picture {i + 1} of {len(shots)}")
    return len(shots)


def check_look(path: Path, look: Look) -> None:
    """Raises InputError for a suffix, a size or a rate that no film can have."""
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(
            f"{path}: films are .mp4 or .webp, or a folder, whose name has no suffix; choose one of these."
        )
    if not (min(look.width, look.height) >= 16 and max(look.width, look.height) <= LONGEST_SIDE):
        raise InputError(f"{look.width} x {look.height} pixels: give sizes from 16 to {LONGEST_SIDE}.")
    if not 0.1 <= look.fps <= 1000:
        raise InputError(f"{look.fps:g} frames a second: give 0.1 to 1000.")
    if path.suffix.lower() == ".mp4" and look.background is None:
        raise InputError(f"{path}: an .mp4 cannot be transparent; write a .webp or a folder of .png, or give a colour.")


def _writer(path: Path, look: Look, count: int):
    kinds = {".mp4": _mp4, ".webp": _webp, "": _png}
    return kinds[path.suffix.lower()](path, look, count)


@contextmanager
def _mp4(path: Path, look: Look, count: int) -> Iterator[Callable[[np.ndarray], None]]:
    """H.264 as every player takes it, with sizes rounded up to even ones by repeating the last row and column."""
    try:
        import av
    except ModuleNotFoundError:
        raise InputError(f"{path}: .mp4 needs PyAV; pip install 'timesplat[video]', or write a .webp.") from None
    odd = ((0, look.height % 2), (0, look.width % 2), (0, 0))
    with atomic_write(path) as tmp:
        try:
            with av.open(str(tmp), "w", format="mp4", options={"movflags": "faststart"}) as file:
                stream = file.add_stream("libx264", rate=Fraction(look.fps).limit_denominator(1001), options=QUALITY)
                stream.width, stream.height = look.width + odd[1][1], look.height + odd[0][1]
                stream.pix_fmt = "yuv420p"

                def add(picture: np.ndarray) -> None:
                    frame = av.VideoFrame.from_ndarray(np.pad(picture[..., :3], odd, "edge"), "rgb24")
                    file.mux(stream.encode(frame))

                yield add
                file.mux(stream.encode(None))
        except (av.FFmpegError, ValueError) as e:
            raise InputError(f"{path}: PyAV cannot write it ({e}); write a .webp or a folder of .png.") from None


@contextmanager
def _webp(path: Path, look: Look, count: int) -> Iterator[Callable[[np.ndarray], None]]:
    frames: list[Image.Image] = []

    def add(picture: np.ndarray) -> None:
        frames.append(Image.fromarray(picture if look.background is None else picture[..., :3]))

    with atomic_write(path) as tmp:
        yield add
        at = [round(1000 * i / look.fps) for i in range(len(frames) + 1)]  # milliseconds
        durations = [max(b - a, 1) for a, b in pairwise(at)]
        options = {"duration": durations, "loop": 0, "quality": WEBP_QUALITY, "method": 4}
        frames[0].save(tmp, "WEBP", save_all=True, append_images=frames[1:], **options)


@contextmanager
def _png(path: Path, look: Look, count: int) -> Iterator[Callable[[np.ndarray], None]]:
    digits, numbers = max(4, len(str(count))), itertools.count(1)
    with new_folder(path) as whole:

        def add(picture: np.ndarray) -> None:
            name = f"{path.name}_{next(numbers):0{digits}d}.png"
            Image.fromarray(picture).save(whole / name, compress_level=4)

        yield add
