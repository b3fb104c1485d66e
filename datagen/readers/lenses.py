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

ROWS = 256  # of a picture that are looked up at a time, so that large ones need no multiple of their memory


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


@lru_cache(maxsize=3)
def _sources(lens: Lens) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where each pixel (H,W) of the straight picture comes from, in pixels, float32, and whether from anywhere."""
    y, x = np.meshgrid(np.arange(lens.height) + 0.5, np.arange(lens.width) + 0.5, indexing="ij")
    u, v, holds = lens.pixels((x - lens.cx) / lens.fx, (y - lens.cy) / lens.fy)
    return u.astype(np.float32), v.astype(np.float32), holds


def straighten(image: np.ndarray, lens: Lens) -> np.ndarray:
    """(H,W,C) uint8 as the lens took it -> the same with straight lines: the pinhole camera with the lens's focal
    lengths and principal point. Beyond its border the picture goes on as it is there; what no ray of the model reaches
    is 0. The last of four channels is alpha, by which the others are weighted."""
    if lens.straight:
        return image
    u, v, holds = _sources(lens)
    out = np.empty_like(image)
    for top in range(0, lens.height, ROWS):
        rows = slice(top, top + ROWS)
        part = sample(image, u[rows], v[rows])
        out[rows] = np.where(holds[rows, :, None], part, 0)
    return out


def sample(image: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """image (H,W,C) uint8 between its pixels, at u, v (…) in pixels -> (…,C) uint8, bilinear; outside as at the border.
    The last of four channels is alpha, by which the others are weighted."""
    height, width, channels = image.shape
    x, y = np.clip(u - 0.5, 0, width - 1), np.clip(v - 0.5, 0, height - 1)
    left, up = np.floor(x).astype(np.intp), np.floor(y).astype(np.intp)
    right, down = np.minimum(left + 1, width - 1), np.minimum(up + 1, height - 1)
    x, y = (x - left)[..., None].astype(np.float32), (y - up)[..., None].astype(np.float32)
    opaque = channels != 4 or bool((image[..., 3] == 255).all())
    total = np.zeros((*u.shape, channels), np.float32)
    for row, col, weight in (
        (up, left, (1 - y) * (1 - x)),
        (up, right, (1 - y) * x),
        (down, left, y * (1 - x)),
        (down, right, y * x),
    ):
        at = image[row, col].astype(np.float32)
        if not opaque:
            weight = weight * np.concatenate([np.repeat(at[..., 3:], 3, -1) / 255, np.ones_like(at[..., 3:])], -1)
        total += weight * at
    if not opaque:
        total[..., :3] /= np.maximum(total[..., 3:] / 255, 1e-6)
    return np.clip(np.rint(total), 0, 255).astype(np.uint8)
