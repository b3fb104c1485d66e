# SPDX-License-Identifier: GPL-3.0-or-later
"""The cameras that the benchmarks look from."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from timesplat.datagen.rigs import FOV, spherical
from timesplat.datagen.sequence import focal_from_fov, opengl_to_opencv


def ring(count: int, size: int) -> tuple[Tensor, Tensor]:
    """c2w (C,4,4) OpenCV axes and intrinsics (C,4) in pixels of `count` cameras around the object, at the default rig's
    distance and field of view, for pictures of size² pixels."""
    poses = np.stack([opengl_to_opencv(spherical(360 * i / count, 0)) for i in range(count)])
    f = focal_from_fov(FOV, size)
    return torch.from_numpy(poses).float(), torch.tensor([f, f, size / 2, size / 2]).expand(count, 4)
