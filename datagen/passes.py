# SPDX-License-Identifier: GPL-3.0-or-later
"""What a renderer knows of a view beyond its picture: depth and motion vectors, as an EXR."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .errors import InputError
from .image_files import write_exr


@dataclass
class Passes:
    """What Blender knows of a view beyond its picture, in pixel rows from the top.

    depth (H,W) float32: planar z of the first surface in normalised units, inf where there is none
    (pixels whose depth is mixed with the background's are set to inf as well);
    flow_next, flow_prev (H,W,2) float32: where the surface point seen at the pixel is one frame later /
    earlier, minus where it is now, in pixels, x right, y DOWN, for a camera that stands still.
    """

    depth: np.ndarray
    flow_next: np.ndarray
    flow_prev: np.ndarray


def read_passes(path: Path, shape: tuple[int, int]) -> Passes:
    """Reads channels Z, flow_next.x/.y, flow_prev.x/.y of a single-part EXR written by `write_passes`."""
    import OpenEXR

    try:
        with OpenEXR.File(str(path), separate_channels=True) as f:
            channel = {k: np.asarray(c.pixels, np.float32) for k, c in f.channels().items()}
        depth = channel["Z"]
        flow = [np.stack([channel[f"{n}.x"], channel[f"{n}.y"]], -1) for n in ("flow_next", "flow_prev")]
    except KeyError as e:
        raise InputError(f"{path}: the channel {e} is missing; render the Sequence again.") from None
    except Exception as e:
        hint = "is missing" if not Path(path).exists() else f"cannot be read ({e})"
        raise InputError(f"{path}: the depth pass {hint}; render the Sequence again.") from None
    if depth.shape != shape:
        raise InputError(
            f"{path}: the depth pass is {depth.shape[1]}x{depth.shape[0]} but transforms.json says "
            f"{shape[1]}x{shape[0]}; render the Sequence again."
        )
    if np.isnan(depth).any() or not all(np.isfinite(x).all() for x in flow):
        raise InputError(f"{path}: the depth pass holds NaN or infinite motion; render the Sequence again.")
    depth[(depth <= 0) | (depth >= 1e9)] = np.inf
    return Passes(depth, *flow)


def write_passes(path: Path, passes: Passes, combined: np.ndarray | None = None) -> None:
    """Single-part ZIP EXR: Z (float), flow_next/flow_prev (half), and R G B A (half, scene-linear
    premultiplied) where `combined` (H,W,4) is given. Infinite depth is written as 1e10, as Blender does."""
    half = np.float16
    channels = {"Z": np.where(np.isinf(passes.depth), 1e10, passes.depth).astype(np.float32)}
    for name, flow in (("flow_next", passes.flow_next), ("flow_prev", passes.flow_prev)):
        for i, axis in enumerate("xy"):
            channels[f"{name}.{axis}"] = np.ascontiguousarray(flow[..., i], half)
    if combined is not None:
        for i, c in enumerate("RGBA"):
            channels[c] = np.ascontiguousarray(combined[..., i], half)
    write_exr(path, channels)
