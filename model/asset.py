# SPDX-License-Identifier: GPL-3.0-or-later
"""A 4D Gaussian asset as arrays, and its .ply file. numpy only, so that it runs inside Blender."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Clip:
    """What leads from the asset's normalised space and time back to the scene it was made from."""

    fps: float = 24.0
    frame_start: int = 0
    frame_end: int = 23  # inclusive; model time -1 is frame_start, +1 is frame_end
    scale: float = 1.0  # world = scale * normalised + translation
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass
class Asset:
    """N 4D Gaussians in kinematic form (see model/gaussians.py), all arrays float32, linear values."""

    xyz: np.ndarray  # (N,3) position at its own time, normalised space
    t: np.ndarray  # (N,) its own time, clip = [-1,1]
    velocity: np.ndarray  # (N,3) normalised units per unit of t
    sigma_t: np.ndarray  # (N,) > 0
    scale: np.ndarray  # (N,3) standard deviations, > 0
    rotation: np.ndarray  # (N,4) unit quaternion w x y z
    rgb: np.ndarray  # (N,3) sRGB-encoded, 0..1
    opacity: np.ndarray  # (N,) 0..1
    clip: Clip = field(default_factory=Clip)

    def __len__(self) -> int:
        return len(self.xyz)
