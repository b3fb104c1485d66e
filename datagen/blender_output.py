# SPDX-License-Identifier: GPL-3.0-or-later
"""What Blender rendered, in our conventions: reads its multi-layer EXR, and turns colour, depth and motion vectors into
those of a Sequence. numpy only."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .image_files import read_exr
from .passes import Passes

BACKGROUND_DEPTH = 1e9  # Blender writes 1e10 where a pixel's depth sample met nothing
# Alpha from which a surface gives a pixel its depth whatever lies behind, and where nothing does. Blender's own measure
# is one half, below which rays draw lots: the lift of boxes of alpha 0.4 has 19.6 dB at one half and 22.0 at 0.2; that
# of a thing inside of a ball of alpha 0.1 has 21.6 dB at 0.2 and 15.4 at 0.02.
SEEN, FAINTEST = 0.2, 0.02


def read_multilayer(path: Path) -> dict[str, np.ndarray]:
    """Blender's EXR of one view: "combined" (H,W,4) scene-linear premultiplied RGBA and, where rendered,
    "z" (H,W) and "vector" (H,W,4), all float32, rows from the top."""
    # Blender 5 writes a part per pass, older ones a single part; the channels' names end alike
    by_end = {".".join(k.split(".")[-2:]): v.astype(np.float32) for k, v in read_exr(path).items()}
    found = {"combined": np.stack([by_end[f"Combined.{c}"] for c in "RGBA"], -1)}
    if "Depth.Z" in by_end:
        found["z"] = by_end["Depth.Z"]
    if "Vector.X" in by_end:
        found["vector"] = np.stack([by_end[f"Vector.{c}"] for c in "XYZW"], -1)
    return found


def to_passes(channels: dict[str, np.ndarray], scale: float) -> Passes:
    """Blender's conventions to ours. Depth is Cycles' first sample of the pixel, not filtered: it is a
    surface's or the background's, never a mixture. Blender's vectors are y up, XY leads back from now to the
    frame before, ZW from the frame after back to now."""
    z, vector = channels["z"], channels["vector"]
    depth = np.where(z < BACKGROUND_DEPTH, z / np.float32(scale), np.float32(np.inf))
    down = np.array([1, -1], np.float32)
    return Passes(depth, -vector[..., 2:] * down, vector[..., :2] * down)


def to_straight_srgb(linear: np.ndarray) -> np.ndarray:
    """(…,4) scene-linear premultiplied -> (…,4) uint8 straight alpha, sRGB-encoded ("Standard" view)."""
    alpha = np.clip(linear[..., 3:], 0, 1)
    rgb = np.clip(linear[..., :3] / np.maximum(alpha, 1e-6), 0, 1)
    rgb = np.where(rgb <= 0.0031308, 12.92 * rgb, 1.055 * rgb ** (1 / 2.4) - 0.055)
    rgba = np.round(np.concatenate([rgb, alpha], -1) * 255).astype(np.uint8)
    rgba[rgba[..., 3] == 0] = 0
    return rgba


def _without_depth(channels: dict[str, np.ndarray]) -> np.ndarray:
    """(H,W) bool: pixels that show something, and no depth of it."""
    return (channels["z"] >= BACKGROUND_DEPTH) & (channels["combined"][..., 3] > FAINTEST)


def shows_faint_surfaces(channels: dict[str, np.ndarray]) -> bool:
    """Whether an area without depth shows something: a pixel and all its neighbours, which no silhouette is."""
    area = _without_depth(channels)
    for axis in (0, 1):
        area = area & np.roll(area, 1, axis) & np.roll(area, -1, axis)
    return bool(area[1:-1, 1:-1].any())


def fill_faint_surfaces(channels: dict[str, np.ndarray], faint: dict[str, np.ndarray]) -> None:
    """Gives `channels` depth and motion of `faint`, the same view rendered so that faint surfaces have them, where they
    have none, or show that surface and have no motion of it."""
    fill = _without_depth(channels) | np.isclose(channels["z"], faint["z"], rtol=1e-4)
    fill &= faint["z"] < BACKGROUND_DEPTH
    for name in ("z", "vector"):
        channels[name][fill] = faint[name][fill]
