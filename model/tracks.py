# SPDX-License-Identifier: GPL-3.0-or-later
"""Tracks4D: Gaussians that keep their looks and ride on paths through the clip.

A track is one set of looks (colour, opacity, scale, rotation) at an offset in a moving frame of reference, and the path
of that frame: knots, evenly spaced in time, place going straight and rotation turning evenly between them, from its
start to its end, outside of which it is not there. Every view of the clip sees the same looks, so that they are learnt
from all of them. A Gaussian of `Gaussians4D` is a track of two knots without turning, but for its lifetime, which fades
as a bell where a track's ends sharply. Many Gaussians may ride on one path: of a rigid part all do.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from .gaussians import Gaussians4D
from .io import paths as io
from .io.asset import STATIC_SIGMA_T, Asset, Clip
from .rotations import quaternion_multiply, rotate

LOOKS = ("offset", "scale", "rotation", "rgb", "opacity")


@dataclass
class Paths:
    """P paths of M knots in all: the tensors of `io.paths.Paths`, which tells what they mean."""

    start: Tensor  # (P,) model time
    end: Tensor  # (P,)
    count: Tensor  # (P,) int64, knots of each
    place: Tensor  # (M,3)
    rotation: Tensor  # (M,4)

    def __len__(self) -> int:
        return len(self.count)

    def to(self, *args, **kwargs) -> Paths:
        return Paths(*(getattr(self, f.name).to(*args, **kwargs) for f in fields(self)))

    def at(self, t: float) -> tuple[Tensor, Tensor]:
        """Places (P,3) and unit quaternions (P,4) at time t in [-1,1]; beyond its ends a path stays where they are."""
        along = ((t - self.start) / (self.end - self.start)).clamp(0, 1) * (self.count - 1)
        whole = torch.minimum(along.floor(), (self.count - 2).clamp_min(0))
        a = self.count.cumsum(0) - self.count + whole.long()
        b = torch.where(self.count > 1, a + 1, a)
        part = (along - whole)[:, None]
        place, rotation = self.place, self.rotation
        return torch.lerp(place[a], place[b], part), F.normalize(torch.lerp(rotation[a], rotation[b], part), dim=-1)

    def there(self, t: float) -> Tensor:
        """(P,) bool: whether what rides on a path is there at time t."""
        return (t >= self.start - io.WINDOW_SLACK) & (t <= self.end + io.WINDOW_SLACK)

    def numpy(self) -> io.Paths:
        """The twin for files and Blender."""
        start, end, place, rotation = (
            getattr(self, k).detach().cpu().float().numpy() for k in ("start", "end", "place", "rotation")
        )
        return io.Paths(start, end, self.count.cpu().numpy().astype(np.int32), place, rotation)

    @staticmethod
    def from_numpy(paths: io.Paths) -> Paths:
        arrays = {f.name: torch.from_numpy(getattr(paths, f.name).copy()) for f in fields(paths)}
        return Paths(**arrays | {"count": arrays["count"].long()})


@dataclass
class Tracks4D:
    """N Gaussians on P paths; a `ReconstructedScene`. Activated, linear values."""

    offset: Tensor  # (N,3) from the path's place, in its moving frame, normalised units
    scale: Tensor  # (N,3) standard deviations > 0
    rotation: Tensor  # (N,4) unit quaternion w x y z in the moving frame
    rgb: Tensor  # (N,3) sRGB-encoded, 0..1 (not enforced)
    opacity: Tensor  # (N,) 0..1
    path: Tensor  # (N,) int64, the row of `paths` that each rides on
    paths: Paths

    def __len__(self) -> int:
        return len(self.offset)

    def __getitem__(self, index) -> Tracks4D:
        """Index or mask of Gaussians; all paths stay."""
        return replace(self, **{k: getattr(self, k)[index] for k in (*LOOKS, "path")})

    def to(self, *args, **kwargs) -> Tracks4D:
        return Tracks4D(*(getattr(self, f.name).to(*args, **kwargs) for f in fields(self)))

    def widened(self, by: float) -> Tracks4D:
        """Blurred by a standard deviation of `by`, in every direction."""
        return replace(self, scale=(self.scale.square() + by**2).sqrt())

    def at(self, t: float) -> Gaussians4D:
        """The Gaussians as they are at time t in [-1,1], for ever; differentiable in the looks, and in the knots' place
        and rotation."""
        place, turn = self.paths.at(t)
        xyz, rotation = self._ride(place, turn)
        opacity = self.opacity
        if not (there := self.paths.there(t)).all():
            opacity = opacity * there[self.path]
        still = torch.zeros_like(self.opacity)
        return Gaussians4D(
            xyz=xyz,
            t=still,
            velocity=torch.zeros_like(xyz),
            sigma_t=torch.full_like(self.opacity, STATIC_SIGMA_T),
            scale=self.scale,
            rotation=rotation,
            rgb=self.rgb,
            opacity=opacity,
        )

    def _ride(self, place: Tensor, turn: Tensor) -> tuple[Tensor, Tensor]:
        """place (P,3), turn (P,4) of the paths -> place (N,3) and rotation (N,4) of the Gaussians."""
        knots_move = place.requires_grad or turn.requires_grad
        if self.offset.dtype == torch.float32 and not self.offset.is_cuda and not knots_move:
            from .riding import Ride  # compiled

            return Ride.apply(self.path, place, turn, self.offset, self.rotation)
        place, turn = place[self.path], turn[self.path]
        return place + rotate(turn, self.offset), quaternion_multiply(turn, self.rotation)

    def alive(self, opacity: float = 0.05) -> Tensor:
        """(N,) bool: whether the paper's inference filter lets the Gaussian through (appendix A.2)."""
        return self.opacity >= opacity

    def to_asset(self, clip: Clip) -> Asset:
        """numpy twin for files and Blender; each Gaussian's own time is the middle of its path's life."""
        paths = self.paths.numpy()
        path = self.path.cpu().numpy().astype(np.int32)
        t = (0.5 * (paths.start + paths.end))[path]
        place, turn = paths.at(t, path)
        looks = {k: np.ascontiguousarray(getattr(self, k).detach().cpu().float().numpy()) for k in LOOKS}
        rotation = io.multiply(turn, looks["rotation"])
        asset = Asset(
            xyz=(place + io.rotate(turn, looks["offset"])).astype(np.float32),
            t=t,
            velocity=np.zeros((len(self), 3), np.float32),
            sigma_t=np.full(len(self), STATIC_SIGMA_T, np.float32),
            scale=looks["scale"],
            rotation=(rotation / np.linalg.norm(rotation, axis=1, keepdims=True)).astype(np.float32),
            rgb=looks["rgb"],
            opacity=looks["opacity"],
            clip=clip,
            path=path,
            paths=paths,
        )
        return asset[np.arange(len(self))]  # without the paths that nothing rides on

    @staticmethod
    def from_asset(asset: Asset) -> Tracks4D:
        """Of an asset that has paths."""
        offset, rotation = asset.on_path()
        looks = {
            "offset": offset,
            "scale": asset.scale,
            "rotation": rotation,
            "rgb": asset.rgb,
            "opacity": asset.opacity,
        }
        tensors = {k: torch.from_numpy(np.array(a, np.float32)) for k, a in looks.items()}
        return Tracks4D(
            **tensors, path=torch.from_numpy(asset.path.astype(np.int64)), paths=Paths.from_numpy(asset.paths)
        )
