# SPDX-License-Identifier: GPL-3.0-or-later
""".4dgs, the container of 4D Gaussians of the package `fourdgs` (4dgs.dev), which reads and writes it: straight
Gaussians in seconds and metres, each with its own time and lifetime, as ours are but for paths. The package is optional
(the extra `fourdgs`), and Blender lacks it.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from ...datagen.sequence import InputError
from .asset import (
    MAX_GAUSSIANS,
    SMALLEST_SCALE,
    STATIC_SIGMA_T,
    Asset,
    Clip,
    LoadedAsset,
    check,
    near_origin,
    sound_part,
    srgb_from_linear,
    unchecked_static_asset,
    wxyz_from_xyzw,
    xyzw_from_wxyz,
)
from .atomic import atomic_write

PROFILE = "fine"  # of the library's: the tightest error that it keeps to
CUTOFF = 0.01  # share of its opacity below which a reader drops a Gaussian; `to_pieces` fade into one another
UP = {"z-up-right-handed": "Z", "y-up-right-handed": "Y"}
AXES = ("X", "Y", "Z", "-X", "-Y", "-Z")  # of the file's coordinate frame
SHARP = 2.0  # half a window that cuts a Gaussian off is so many of the σ_t that stand in for it
DAMAGE = (ValueError, KeyError, IndexError, TypeError, OverflowError, AttributeError, struct.error, zlib.error)


def _library(path: str | Path) -> ModuleType:
    try:
        import fourdgs
    except ImportError:
        raise InputError(f"{path}: .4dgs needs the package fourdgs; pip install 'timesplat[fourdgs]'.") from None
    return fourdgs


def write_4dgs(path: str | Path, asset: Asset) -> None:
    """Writes an asset without paths, `softened`; whole or not at all. All is rounded, to the bounds that the file
    states, and colours beyond 0..1 are clamped. Raises InputError."""
    fourdgs = _library(path)
    check(asset, path)
    clip = asset.clip
    asset = asset.softened()
    second = max(clip.frame_end - clip.frame_start, 1) / (2 * clip.fps)  # of a unit of model time
    n, end = len(asset), (clip.frame_end - clip.frame_start + 1) / clip.fps
    gaussians = fourdgs.GaussianSet(
        positions=(asset.xyz * np.float32(clip.scale) + np.array(clip.translation, np.float32)),
        scales=asset.scale * np.float32(clip.scale),
        rotations=xyzw_from_wxyz(asset.rotation),
        colors=np.concatenate([asset.rgb.clip(0, 1), asset.opacity[:, None]], 1),
        motions=asset.velocity * np.float32(clip.scale / second),
        mu_t=((asset.t + 1) * second).astype(np.float32),
        sigma_t=np.where(asset.sigma_t >= STATIC_SIGMA_T, np.inf, asset.sigma_t * second).astype(np.float32),
        win_lo=np.zeros(n),
        win_hi=np.full(n, end),
    )
    about = {
        "coordinate_system": "z-up-right-handed",
        "color_space": "srgb-rec709-display",
        "meters_per_unit": "1",
        "fps": repr(clip.fps),
        "frame_start": str(clip.frame_start),
    }
    options = fourdgs.WriteOptions(profile=PROFILE, cutoff=CUTOFF, library="Timesplat", metadata=about)
    with atomic_write(path) as tmp:
        try:
            fourdgs.write(str(tmp), gaussians, end, options=options)
        except (fourdgs.FourdgsError, *DAMAGE) as e:
            raise InputError(f"{path}: the package fourdgs cannot write this ({e}); export a .ply.") from None


def read_4dgs(path: Path) -> LoadedAsset:
    """A .4dgs of the model `gaussian-birth`, the only one whose Gaussians move by themselves. Raises InputError."""
    fourdgs = _library(path)
    data = path.read_bytes()
    try:
        scene = fourdgs.read(data, recover_truncated=False)
        gaussians, about = scene.gaussians, scene.header.attributes
        if not 0 < gaussians.count <= MAX_GAUSSIANS:
            raise InputError(f"{path}: it holds {gaussians.count:,} Gaussians; 1 to {MAX_GAUSSIANS:,} can be read.")
        fps, start = float(about.get("fps", 24)), int(about.get("frame_start", 1))
        size, up = float(about.get("meters_per_unit", 1)), UP.get(about.get("coordinate_system", ""), "-Y")
        if frame := scene.provenance.frame:
            size, up = frame.metres_per_unit or size, AXES[frame.up_axis]
        if up not in ("Z", "Y", "-Y"):
            raise InputError(f"{path}: {up} is up in it; turn it so that Z or Y is, and export it again.")
        last = start + max(round(scene.duration_sec * fps), 1) - 1
        clip = Clip(fps, start, last, size)
        asset, notes = _asset(gaussians, clip, about.get("color_space") == "linear-rec709-display")
    except fourdgs.FourdgsError as e:
        raise InputError(f"{path}: it cannot be read as .4dgs ({e}); export it again.") from None
    except DAMAGE as e:
        raise InputError(f"{path}: the .4dgs is damaged ({e}); export it again.") from None
    for what, there in (("its sound", scene.audio_sources), ("the motion of its objects", scene.objects.tracks)):
        if there:
            notes.append(f"{what[0].upper()}{what[1:]} is left out.")
    asset, left_out = sound_part(asset, path)
    return LoadedAsset(asset, up, " ".join(filter(None, (left_out, *notes))))


def _asset(gaussians: Any, clip: Clip, linear: bool) -> tuple[Asset, list[str]]:
    """Unchecked, and what is to be said of it."""
    notes = []
    second = max(clip.frame_end - clip.frame_start, 1) / (2 * clip.fps)
    mu, sigma = gaussians.mu_t.astype(np.float64), gaussians.sigma_t.astype(np.float64)
    low, high = (np.asarray(x, np.float64) for x in (gaussians.win_lo, gaussians.win_hi))
    end = (clip.frame_end - clip.frame_start + 1) / clip.fps
    reach = 2 * np.where(np.isfinite(sigma), sigma, np.inf)
    late, early = np.maximum(mu - reach, 0) < low - 1e-6, np.minimum(mu + reach, end) > high + 1e-6
    if (cut := late | early).any():
        notes.append(f"{cut.sum()} Gaussians that come or go at once fade in or out instead.")
        low, high = np.maximum(low, 0), np.minimum(high, end)
        at, width = (low + high) / 2, np.maximum(high - low, 1e-6) / 2 / SHARP
        moved = np.where(cut, at, mu) - mu
        xyz = gaussians.positions + gaussians.motions * moved[:, None]
        mu, sigma = mu + moved, np.where(cut, np.minimum(sigma, width), sigma)
    else:
        xyz = gaussians.positions
    xyz, middle = near_origin(np.asarray(xyz, np.float64))
    rgb = np.asarray(gaussians.colors[:, :3], np.float32)
    still = unchecked_static_asset(
        xyz=xyz,
        scale=np.maximum(gaussians.scales, SMALLEST_SCALE),
        rotation=wxyz_from_xyzw(np.asarray(gaussians.rotations)),
        rgb=srgb_from_linear(rgb) if linear else rgb,
        opacity=gaussians.colors[:, 3],
    )
    with np.errstate(over="ignore", invalid="ignore"):
        times = {
            "t": mu / second - 1,
            "velocity": gaussians.motions * second,
            "sigma_t": np.where(np.isfinite(sigma), np.maximum(sigma / second, 1e-6), STATIC_SIGMA_T),
        }
        exact: dict[str, Any] = {k: np.ascontiguousarray(a, np.float32) for k, a in times.items()}
    if gaussians.sh is not None and gaussians.sh_degree:
        notes.append("Its colours that depend on the direction (spherical harmonics) are left out.")
    x, y, z = (float(m * clip.scale) for m in middle)
    return replace(still, **exact, clip=replace(clip, translation=(x, y, z))), notes
