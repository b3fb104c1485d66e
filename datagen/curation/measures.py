# SPDX-License-Identifier: GPL-3.0-or-later
"""What can be measured of a rendered Sequence without knowing what it shows. numpy only.

All of it looks at the canonical cameras, which stand still, over white; at all cameras where a Sequence has none.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ..rigs import CANONICAL
from ..sequence import Sequence

SEEN = 8  # alpha, of 255, from which a pixel counts as shown
SOLID = 250  # from which it shows a surface and nothing behind
FEW = 4e-4  # of the pixels: pictures that show less show nothing
_ROWS, _COLUMNS = 8, 9  # of the small pictures that hashes are made of
_STEP = 3.0  # of 255: smaller differences of two neighbours in them are noise


@dataclass(frozen=True)
class Measures:
    """Of one Sequence.

    motion      how much moves, see `motion_of`; NaN where no canonical camera has two frames
    moves       whether motion is promised: a clip of several frames, of an object that is not merely displaced
    still       whether it is a still object, as it is or displaced
    border      largest share of a picture's outermost pixels that show something
    empty       share of the moments at which no picture shows anything
    size        median over the moments of the larger side of what is shown, in pictures' sides
    growth      the largest such size over the median
    variety     how much colours differ, 0..1: the standard deviation over all solid pixels, mean over the channels
    magenta     share of the solid pixels that have the colour by which Blender says that a texture is missing
    hash        perceptual, of the first moment from the canonical cameras, 64 bits each, in hexadecimal; "" without
    """

    motion: float
    moves: bool
    still: bool
    border: float
    empty: float
    size: float
    growth: float
    variety: float
    magenta: float
    hash: str


def measure(seq: Sequence) -> Measures:
    """Reads the pictures. Raises InputError for one that is missing or damaged."""
    pictures = by_camera(seq)
    several = seq.frame_end > seq.frame_start
    displaced = bool(seq.provenance.get("settings", {}).get("displace"))
    canonical = {name: p for name, p in pictures.items() if name in CANONICAL}
    stack = np.concatenate(list(pictures.values()))
    frames = np.concatenate([_frames(seq, name) for name in pictures])
    sizes = np.array([_size(stack[frames == f]) for f in np.unique(frames)])
    shown = sizes[sizes > 0]
    median = float(np.median(shown)) if len(shown) else 0.0
    solid = stack[stack[..., 3] >= SOLID][:, :3].astype(np.float32) / 255
    return Measures(
        motion=motion_of(canonical.values()),
        moves=several and not displaced,
        still=displaced or not several,
        border=_border(stack),
        empty=float(np.mean(sizes == 0)),
        size=median,
        growth=float(shown.max() / median) if len(shown) else 0.0,
        variety=float(solid.std(0).mean()) if len(solid) else 0.0,
        magenta=float(_is_magenta(solid).mean()) if len(solid) else 0.0,
        hash="".join(_hash(canonical[name][0]) for name in CANONICAL if name in canonical),
    )


def by_camera(seq: Sequence) -> dict[str, np.ndarray]:
    """{camera: (F,H,W,4) uint8 straight RGBA over time}: the canonical cameras, or all where there is none."""
    cameras = sorted({v.camera for v in seq.views})
    names = [name for name in cameras if name in CANONICAL] or cameras
    return {name: np.stack([seq.load_image(i) for i in _indices(seq, name)]) for name in names}


def _indices(seq: Sequence, camera: str) -> list[int]:
    return sorted(seq.select(camera=camera), key=lambda i: seq.views[i].frame)


def _frames(seq: Sequence, camera: str) -> np.ndarray:
    return np.array([seq.views[i].frame for i in _indices(seq, camera)])


def motion_of(cameras: Iterable[np.ndarray]) -> float:
    """How much a clip moves: the greatest L1 distance between two frames of a camera that stands still (paper,
    appendix, "Dataset Curation"), mean over the cameras, each (F,H,W,4) uint8. 0..1 per colour channel over
    white, per pixel that the object covers at any of the frames, so that slim objects count as stout ones do; NaN where
    no camera has two frames."""
    found = []
    for rgba in cameras:
        if len(rgba) < 2:
            continue
        covered = (rgba[..., 3] > 0).any(0)
        seen = over_white(rgba[:, covered]).reshape(len(rgba), -1)
        most = max(float(np.abs(seen[i + 1 :] - seen[i]).sum(1).max()) for i in range(len(seen) - 1))
        found.append(most / (3 * max(int(covered.sum()), 1)))
    return float(np.mean(found)) if found else float("nan")


def over_white(rgba: np.ndarray) -> np.ndarray:
    """(…,4) uint8 straight -> (…,3) float32 0..1."""
    alpha = rgba[..., 3:].astype(np.float32) / 255
    return rgba[..., :3].astype(np.float32) / 255 * alpha + 1 - alpha


def shrunk(picture: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """(H,W,C) -> (rows,columns,C): means of areas that are as alike as whole pixels allow."""
    tall, wide = (np.linspace(0, n, k + 1).astype(int) for n, k in zip(picture.shape, (rows, columns), strict=False))
    sums = np.add.reduceat(np.add.reduceat(picture.astype(np.float64), tall[:-1], 0), wide[:-1], 1)
    return sums / (np.diff(tall)[:, None, None] * np.diff(wide)[None, :, None])


def _size(pictures: np.ndarray) -> float:
    """The larger side of what pictures (n,H,W,4) of one moment show, mean over them, in their sides; 0 for nothing."""
    found = []
    for seen in pictures[..., 3] >= SEEN:
        if seen.mean() < FEW:
            continue
        sides = [np.flatnonzero(seen.any(axis)) for axis in (1, 0)]
        found.append(max((side[-1] - side[0] + 1) / n for side, n in zip(sides, seen.shape, strict=True)))
    return float(np.mean(found)) if found else 0.0


def _border(pictures: np.ndarray) -> float:
    seen = pictures[..., 3] >= SEEN
    ring = np.concatenate([seen[:, 0], seen[:, -1], seen[:, 1:-1, 0], seen[:, 1:-1, -1]], 1)
    return float(ring.mean(1).max())


def _is_magenta(rgb: np.ndarray) -> np.ndarray:
    """(N,3) 0..1 -> (N,) bool: red and blue alike, and no green to speak of."""
    red, green, blue = rgb.T
    least, most = np.minimum(red, blue), np.maximum(red, blue)
    return (least > 0.3) & (green < 0.1 * most) & (least > 0.85 * most)


def _hash(rgba: np.ndarray) -> str:
    """64 bits of a picture (H,W,4): where its brightness rises to the right, in 8 rows of 9."""
    grey = shrunk(over_white(rgba).mean(-1, keepdims=True) * 255, _ROWS, _COLUMNS)[..., 0]
    return np.packbits(np.diff(grey, axis=1) > _STEP).tobytes().hex()
