# SPDX-License-Identifier: GPL-3.0-or-later
"""PlayCanvas's .sog, version 2: the Gaussians of one moment as lossless WebP pictures in a .zip, a pixel for each.
Pillow, which Blender lacks, reads and writes the pictures; no kept library writes the rest.

Source: developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog.
"""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from ...datagen.sequence import InputError
from .asset import MAX_GAUSSIANS, SH_C0, Asset, LoadedAsset, sound_part, unchecked_static_asset

LEVELS = 256  # of a codebook, which scales share, and colours
ROUNDS = 20  # of finding the levels
LARGEST_TAG = 252  # of alpha, and beyond: which component of the quaternion is the largest, and left out
OTHERS = np.array([[k for k in range(4) if k != largest] for largest in range(4)])
MOST_META = 1 << 20  # bytes of meta.json


def sog(part: Asset, frame: float) -> bytes:
    """`part` as `slices.slice_at` gives it, with -Y up. Places are rounded to a 65,535th of the box (in logarithms:
    finer near the origin), scales and colours to the best 256 values of all, opacities and quaternions to bytes. Raises
    InputError where Pillow is missing."""
    part = part[_along_a_curve(part.xyz)]
    n = len(part)
    width = -(-int(np.ceil(np.sqrt(n))) // 4) * 4
    height = -(-n // width // 4) * 4
    place = np.sign(part.xyz) * np.log1p(np.abs(part.xyz.astype(np.float64)))
    low, high = place.min(0), place.max(0)
    steps = np.round((place - low) / np.where(high > low, high - low, 1) * 65535).astype(np.uint16)
    scales, scale = _codebook(np.log(part.scale))
    colours, colour = _codebook((part.rgb - 0.5) / SH_C0)
    opacity = np.round(part.opacity * 255).astype(np.uint8)[:, None]
    largest = np.abs(part.rotation).argmax(1)
    rows = np.arange(n)
    q = part.rotation * np.where(part.rotation[rows, largest] < 0, -1, 1)[:, None]
    small = np.round((q[rows[:, None], OTHERS[largest]] * np.sqrt(0.5) + 0.5) * 255).clip(0, 255)
    pictures = {
        "means_l.webp": steps & 255,
        "means_u.webp": steps >> 8,
        "scales.webp": scale,
        "quats.webp": np.concatenate([small, LARGEST_TAG + largest[:, None]], 1),
        "sh0.webp": np.concatenate([colour, opacity], 1),
    }
    meta = {
        "version": 2,
        "asset": {"generator": "Timesplat", "frame": float(frame)},
        "count": n,
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scales, "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": colours, "files": ["sh0.webp"]},
    }
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as bundle:
        bundle.writestr(zipfile.ZipInfo("meta.json"), json.dumps(meta, separators=(",", ":")))
        for name, values in pictures.items():
            bundle.writestr(zipfile.ZipInfo(name), _picture(values.astype(np.uint8), width, height))
    return out.getvalue()


def _along_a_curve(xyz: np.ndarray) -> np.ndarray:
    """The order (N,) along a Z-curve of ten bits an axis: neighbours in the pictures are neighbours in space."""
    low, high = xyz.min(0), xyz.max(0)
    cells = ((xyz - low) / np.maximum(high - low, 1e-20) * 1023).astype(np.uint32)
    code = np.zeros(len(xyz), np.uint32)
    for bit in range(10):
        for axis in range(3):
            code |= (cells[:, axis] >> np.uint32(bit) & np.uint32(1)) << np.uint32(3 * bit + axis)
    return np.argsort(code, kind="stable")


def _codebook(values: np.ndarray) -> tuple[list[float], np.ndarray]:
    """LEVELS numbers, rising, that miss the values (…) least by squares (Lloyd's way), and which of them (…) stands for
    each value."""
    ranked = np.sort(values.ravel().astype(np.float64))
    sums = np.concatenate([[0], ranked.cumsum()])
    count, edges = np.histogram(ranked, 16 * LEVELS)
    share = np.concatenate([[0], np.cumsum(np.cbrt(count))])  # so dense is best (Panter and Dite)
    levels = np.interp(np.linspace(0, share[-1], LEVELS), share, edges)
    for _ in range(ROUNDS):
        ends = np.concatenate([[0], np.searchsorted(ranked, (levels[1:] + levels[:-1]) / 2), [len(ranked)]])
        count = np.diff(ends)
        levels = np.where(count > 0, np.diff(sums[ends]) / np.maximum(count, 1), levels)
    levels = np.array([float(f"{x:.7g}") for x in levels])  # as many digits as matter
    return levels.tolist(), np.searchsorted((levels[1:] + levels[:-1]) / 2, values).astype(np.uint8)


def _picture(values: np.ndarray, width: int, height: int) -> bytes:
    """(N,3) or (N,4) bytes, row by row, as a lossless WebP with nothing left out where it is transparent."""
    image = _pillow().Image
    pixels = np.full((width * height, 4), 255, np.uint8)
    pixels[: len(values), : values.shape[1]] = values
    pixels[len(values) :] = pixels[len(values) - 1]
    out = io.BytesIO()
    image.fromarray(pixels.reshape(height, width, 4)).save(out, "WEBP", lossless=True, exact=True)
    return out.getvalue()


def _pillow() -> Any:
    try:
        import PIL.Image
    except ImportError:
        raise InputError(".sog needs Pillow, which this Python lacks; set up Timesplat's runtime.") from None
    return PIL


# ---------------------------------------------------------------- the other way


def read_sog(path: Path) -> LoadedAsset:
    """A .sog of version 2 in one file; -Y is up, as in 3DGS. Nothing is unpacked beyond what its count asks for. Raises
    InputError."""
    try:
        with zipfile.ZipFile(path) as bundle:
            with bundle.open("meta.json") as f:
                meta = json.loads(f.read(MOST_META))
            if meta.get("version") != 2:
                raise InputError(f"{path}: it is .sog version {meta.get('version', 1)}, known is 2; export it anew.")
            n = int(meta["count"])
            if not 0 < n <= MAX_GAUSSIANS:
                raise InputError(f"{path}: it claims {n:,} Gaussians; 1 to {MAX_GAUSSIANS:,} can be read.")
            pixels = {k: [_pixels(bundle, f, n) for f in meta[k]["files"]] for k in ("means", "scales", "quats", "sh0")}
        low, high = (np.array(meta["means"][k], np.float64).reshape(3) for k in ("mins", "maxs"))
        lower, upper = pixels["means"]
        place = low + (high - low) * (lower[:, :3] + 256.0 * upper[:, :3]) / 65535
        scales, colours = (np.array(meta[k]["codebook"], np.float64).reshape(LEVELS) for k in ("scales", "sh0"))
        with np.errstate(over="ignore", invalid="ignore"):
            asset = unchecked_static_asset(
                xyz=np.sign(place) * np.expm1(np.abs(place)),
                scale=np.exp(scales[pixels["scales"][0][:, :3]]),
                rotation=_rotations(pixels["quats"][0]),
                rgb=0.5 + SH_C0 * colours[pixels["sh0"][0][:, :3]],
                opacity=pixels["sh0"][0][:, 3] / 255,
            )
    except zipfile.BadZipFile:
        raise InputError(f"{path}: it is no .sog, or truncated; copy or export it again.") from None
    except (KeyError, ValueError, TypeError, AttributeError, IndexError, RuntimeError, EOFError, zlib.error) as e:
        raise InputError(f"{path}: the .sog is damaged ({e}); export it again.") from None
    asset, left_out = sound_part(asset, path)
    harmonics = "Its colours that depend on the direction (spherical harmonics) are left out." if "shN" in meta else ""
    return LoadedAsset(asset, "-Y", " ".join(filter(None, (left_out, harmonics))))


def _pixels(bundle: zipfile.ZipFile, name: str, n: int) -> np.ndarray:
    """(n,4) bytes of one picture."""
    pillow, packed = _pillow(), bundle.getinfo(name)
    if packed.file_size > 16 * n + (1 << 16):
        raise ValueError(f"{name} is larger than {n} pixels are")
    try:
        with pillow.Image.open(io.BytesIO(bundle.read(packed)), formats=("WEBP", "PNG")) as image:
            width, height = image.size
            if not n <= width * height <= 2 * n + (1 << 16):
                raise ValueError(f"{name} has {width} x {height} pixels for {n} Gaussians")
            return np.asarray(image.convert("RGBA")).reshape(-1, 4)[:n]
    except (OSError, pillow.UnidentifiedImageError, pillow.Image.DecompressionBombError) as e:
        raise ValueError(f"{name}: {e}") from None


def _rotations(pixels: np.ndarray) -> np.ndarray:
    """(N,4) bytes -> quaternions w x y z; without a tag that is known, not turned."""
    known = pixels[:, 3] >= LARGEST_TAG
    largest = np.where(known, pixels[:, 3], LARGEST_TAG).astype(int) - LARGEST_TAG
    small = (pixels[:, :3] / 255 - 0.5) * np.sqrt(2)
    q = np.zeros((len(pixels), 4))
    rows = np.arange(len(q))
    q[rows[:, None], OTHERS[largest]] = small
    q[rows, largest] = np.sqrt(np.maximum(0, 1 - (small**2).sum(1)))
    return np.where(known[:, None], q, [1.0, 0, 0, 0])
