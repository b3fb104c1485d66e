# SPDX-License-Identifier: GPL-3.0-or-later
"""Surface points followed through a clip, as a Sequence keeps them beside its pictures: `tracks.npz`. numpy only.

A renderer that has the scene knows where every point of every surface is at each frame. A sample of them, each with an
orthonormal frame of reference that turns with the surface, is what the method `tracks` hangs its Gaussians on.
"""

from __future__ import annotations

import zipfile
import zlib
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np


@dataclass(frozen=True)
class SurfaceTracks:
    """N surface points through the F frames of a clip, in normalised space.

    Before a point's first frame and after its last one, position and rotation are those of the nearest frame at which
    it is there."""

    position: np.ndarray  # (N,F,3) float32
    rotation: np.ndarray  # (N,F,4) float16, unit quaternions w x y z of the moving frame: z is the outward normal.
    first: np.ndarray  # (N,) int32, frame of the clip (from 0 on) at which the point is there first …
    last: np.ndarray  # (N,) int32, … and last; F - 1 for what stays
    area: np.ndarray  # (N,) float32 > 0, of the surface that the point stands for, normalised units²

    def __len__(self) -> int:
        return len(self.position)


_KINDS = {"position": np.float32, "rotation": np.float16, "first": np.int32, "last": np.int32, "area": np.float32}


def write_tracks(path: Path, tracks: SurfaceTracks) -> None:
    """Writes the file: an uncompressed .npz with an array for each field."""
    np.savez(path, **{f.name: np.ascontiguousarray(getattr(tracks, f.name), _KINDS[f.name]) for f in fields(tracks)})


def read_tracks(path: Path, frames: int) -> SurfaceTracks:
    """Reads what `write_tracks` wrote of a clip of so many frames. Raises ValueError that says what is wrong with it,
    OSError where there is none. Nothing in the file is executed."""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in _KINDS}
    except KeyError as e:
        raise ValueError(f"the array {e} is missing") from None
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as e:  # as the zip says it is
        raise ValueError(f"it is damaged: {e}") from None
    n = len(arrays["position"]) if arrays["position"].ndim else 0
    shapes = {"position": (n, frames, 3), "rotation": (n, frames, 4), "first": (n,), "last": (n,), "area": (n,)}
    for name, kind in _KINDS.items():
        if arrays[name].shape != shapes[name] or arrays[name].dtype != kind:
            raise ValueError(f"{name} is {arrays[name].dtype} {arrays[name].shape}, not {kind.__name__} {shapes[name]}")
        if not np.isfinite(arrays[name]).all():
            raise ValueError(f"{name} holds NaN or infinity")
    t = SurfaceTracks(**arrays)
    if not ((t.first >= 0) & (t.first <= t.last) & (t.last < frames)).all() or not (t.area > 0).all():
        raise ValueError("first and last frame or area are out of range")
    if n and np.abs(np.linalg.norm(t.rotation.astype(np.float32), axis=-1) - 1).max() > 0.01:
        raise ValueError("rotation holds quaternions that are not of unit length")
    return t
