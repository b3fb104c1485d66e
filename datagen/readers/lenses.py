# SPDX-License-Identifier: GPL-3.0-or-later
"""Lenses: where the ideal pinhole camera's rays end in a picture, and pictures as that pinhole camera would have them.

The models are OpenCV's, as COLMAP, nerfstudio and instant-ngp use them: Brown's (radial, tangential; with a divisor:
FULL_OPENCV) and the fisheye of Kannala and Brandt. A picture is made straight once, at its own size and with its own
focal lengths and principal point, by looking up where each of its pixels comes from: nothing has to be inverted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np


@dataclass(frozen=True)
class Lens:
    """The inside of a camera. Pixel centres are at +0.5, y points down."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    radial: tuple[float, ...] = ()  # k1, k2, … of r², r⁴, …; of θ², θ⁴, … for a fisheye
    divisor: tuple[float, ...] = ()  # what the radial factor is divided by, likewise: k4, k5, k6 of FULL_OPENCV
    tangential: tuple[float, float] = (0.0, 0.0)  # p1, p2
    fisheye: bool = False

    @property
    def straight(self) -> bool:
        """Whether it is a pinhole camera."""
        return not (self.fisheye or any(self.radial) or any(self.divisor) or any(self.tangential))

    def resized(self, width: int, height: int) -> Lens:
        """The same lens on a picture that was resized to width x height pixels."""
        x, y = width / self.width, height / self.height
        return replace(self, width=width, height=height, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y)

    def pixels(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """x, y (…) of rays in camera space at z = 1 (OpenCV axes) -> where they end in the picture, in pixels, and
        whether the model holds there: far outside, its polynomial turns back."""
        r2 = x * x + y * y
        if self.fisheye:
            r = np.sqrt(r2)
            theta = np.arctan(r)
            u = theta * theta
            factor = np.where(r > 1e-8, theta / np.maximum(r, 1e-8), 1.0) * _polynomial(self.radial, u)
            rising = _slope(self.radial, u) > 0
        else:
            divisor = _polynomial(self.divisor, r2)
            factor = _polynomial(self.radial, r2) / divisor
            # The derivative of r times the factor, by r.
            rising = _slope(self.radial, r2) * divisor > _polynomial(self.radial, r2) * (
                _slope(self.divisor, r2) - divisor
            )
        p1, p2 = self.tangential
        bent_x = x * factor + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        bent_y = y * factor + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        return self.fx * bent_x + self.cx, self.fy * bent_y + self.cy, rising


def _polynomial(k: tuple[float, ...], u: np.ndarray) -> np.ndarray:
    """1 + k1 u + k2 u² + …"""
    total = np.ones_like(u)
    for n, x in enumerate(k, 1):
        total = total + x * u**n
    return total


def _slope(k: tuple[float, ...], u: np.ndarray) -> np.ndarray:
    """The derivative by r of r (1 + k1 r² + k2 r⁴ + …), at u = r²."""
    return _polynomial(tuple((2 * n + 1) * x for n, x in enumerate(k, 1)), u)


@dataclass(frozen=True)
class Taps:
    """Where the pixels of a picture come from in another: the upper left of four neighbours, numbered by rows, and how
    much of the right and of the lower ones. Outside it is as at the border."""

    corner: np.ndarray  # (…) int32
    right: np.ndarray  # (…) float32 0..1
    lower: np.ndarray  # (…) float32 0..1

    @staticmethod
    def at(u: np.ndarray, v: np.ndarray, width: int, height: int) -> Taps:
        """For places u, v (…) in pixels, in a picture of two pixels or more each way."""
        x, y = np.clip(u - 0.5, 0, width - 1), np.clip(v - 0.5, 0, height - 1)
        left, upper = np.minimum(x.astype(np.int32), width - 2), np.minimum(y.astype(np.int32), height - 2)
        return Taps(upper * width + left, (x - left).astype(np.float32), (y - upper).astype(np.float32))

    def of(self, plane: np.ndarray) -> np.ndarray:
        """plane (H,W) -> (…) float32 between its pixels, bilinear."""
        flat, width = plane.ravel(), plane.shape[1]
        a, b, c, d = (flat.take(self.corner + k).astype(np.float32) for k in (0, 1, width, width + 1))
        upper = a + self.right * (b - a)
        return upper + self.lower * (c + self.right * (d - c) - upper)


@lru_cache(maxsize=3)
def _sources(lens: Lens) -> tuple[Taps, np.ndarray]:
    """Where each pixel (H,W) of the straight picture comes from, and whether from anywhere."""
    y, x = np.meshgrid(np.arange(lens.height) + 0.5, np.arange(lens.width) + 0.5, indexing="ij")
    u, v, holds = lens.pixels((x - lens.cx) / lens.fx, (y - lens.cy) / lens.fy)
    return Taps.at(u, v, lens.width, lens.height), holds


def straighten(image: np.ndarray, lens: Lens) -> np.ndarray:
    """(H,W,4) uint8 RGBA as the lens took it -> the same with straight lines: the pinhole camera with the lens's focal
    lengths and principal point. Beyond its border the picture goes on as it is there; what no ray of the model reaches
    is 0. Colours are weighted by alpha."""
    if lens.straight:
        return image
    taps, holds = _sources(lens)
    out = sample(image, taps)
    if not holds.all():
        out[~holds] = 0
    return out


def sample(image: np.ndarray, taps: Taps) -> np.ndarray:
    """image (H,W,4) uint8 RGBA between its pixels -> (…,4) uint8, bilinear; colours are weighted by alpha."""
    out = np.empty((*taps.corner.shape, 4), np.uint8)
    if (image[..., 3] == 255).all():
        out[..., 3] = 255
        for c in range(3):
            out[..., c] = np.rint(taps.of(image[..., c]))
        return out
    share = image[..., 3].astype(np.float32) / 255
    alpha = taps.of(share)
    for c in range(3):
        out[..., c] = np.rint(np.minimum(taps.of(image[..., c] * share) / np.maximum(alpha, 1e-6), 255))
    out[..., 3] = np.rint(255 * alpha)
    return out
