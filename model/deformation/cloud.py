# SPDX-License-Identifier: GPL-3.0-or-later
"""A cloud of Gaussians at rest and the control points that move it, while it is fitted; and the tracks that it is."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from ..gaussians import Gaussians4D
from ..geometry.shared_paths import ride
from ..geometry.surroundings import expanded
from ..io.asset import STATIC_SIGMA_T
from ..rotations import conjugate, quaternion_multiply, rotate
from ..tracks import Tracks4D
from .motion_table import MotionTable, spread_points
from .posing import Bending
from .skinning import Skin

CONTROL_POINTS = 800
NEAREST = 4  # control points by which a Gaussian is moved
NEIGHBOURS = 6  # control points that a control point should keep its distance from
INVERSIONS = 5  # steps by which it is found where a point is at rest
SEEN = 0.05  # opacity from which on a Gaussian may have a control point


@dataclass
class ControlPoints:
    """C points at rest that are moved by a table, and move what is near."""

    rest: Tensor  # (C,3)
    weights: tuple[Tensor, Tensor]  # the table's places that move them (C,S) int32, and how much
    neighbours: Tensor  # (C,J) rows of the nearest others
    gap: float  # the median distance between neighbours, by which influence falls off

    @staticmethod
    def among(points: Tensor, table: MotionTable, generator: torch.Generator) -> ControlPoints:
        """Some of the points (N,3), 2 or more, that lie far apart."""
        rest = spread_points(points, CONTROL_POINTS, generator)
        apart = torch.cdist(rest, rest)
        nearest = apart.topk(min(NEIGHBOURS + 1, len(rest)), largest=False)
        gap = float(nearest.values[:, 1:NEAREST].mean(1).median())
        return ControlPoints(rest, table.weights(rest), nearest.indices[:, 1:], max(gap, 1e-4))

    def influence(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """points (N,3) -> the control points that move each (N,K) int32, and how much (N,K), of sum 1."""
        parts = [
            torch.cdist(p, self.rest).topk(min(NEAREST, len(self.rest)), largest=False) for p in points.split(8192)
        ]
        distance, near = (torch.cat([p[i] for p in parts]) for i in range(2))
        weight = torch.exp(-0.5 * (distance / self.gap).square()) + 1e-8
        return near.int(), weight / weight.sum(1, keepdim=True)

    def bending(self, place: Tensor, turn: Tensor) -> Tensor:
        """place (C,3), turn (C,4) -> () how far neighbours are from where each would carry them if it were rigid, mean
        square over the gap's (as-rigid-as-possible, Sorkine and Alexa 2007; SC-GS)."""
        return Bending.apply(self.neighbours, self.rest, place, turn) / self.gap**2


@dataclass
class DeformingCloud:
    """A `DynamicScene` of what is trained: xyz (N,3), scale (N,3) log, rotation (N,4), rgb (N,3) and opacity (N,) logit
    at rest, and the table's values; and `life` (N,2), from when to when each is there, model time."""

    values: dict[str, Tensor]
    table: MotionTable
    control: ControlPoints
    near: Tensor  # (N,K) int32
    weight: Tensor  # (N,K)
    whole: bool = False  # all of a scene: it lies and moves in contracted space (`geometry/surroundings.py`)
    poses: dict[float, tuple[Tensor, Tensor]] = field(default_factory=dict)  # of the control points, at times asked for

    def __post_init__(self):
        v = self.values
        self.scale, self.rotation = v["scale"].exp(), F.normalize(v["rotation"], dim=-1)
        self.opacity = v["opacity"].sigmoid()

    def __len__(self) -> int:
        return len(self.values["xyz"])

    def pose(self, t: float) -> tuple[Tensor, Tensor]:
        """Place (C,3) and turn (C,4) of the control points at time t."""
        if t not in self.poses:
            self.poses[t] = self.table.pose(self.values["motion"], self.control.weights, self.control.rest, t)
        return self.poses[t]

    def at(self, t: float) -> Gaussians4D:
        """The scene at time t in [-1,1], differentiable."""
        v = self.values
        xyz, rotation = Skin.apply(self.near, self.weight, self.control.rest, *self.pose(t), v["xyz"], self.rotation)
        still, always = torch.zeros_like(self.opacity), torch.full_like(self.opacity, STATIC_SIGMA_T)
        xyz, scale = self._expanded(xyz)
        velocity = torch.zeros_like(xyz)
        birth, death = v["life"].unbind(1)
        there = (birth <= t) & (t <= death)
        opacity = self.opacity if there.all() else self.opacity * there
        return Gaussians4D(xyz, still, velocity, always, scale, rotation, v["rgb"], opacity)

    def moved(self, xyz: Tensor, t: float) -> tuple[Tensor, Tensor]:
        """xyz (N,3) at rest, of any points -> where they are at time t (N,3), and how they are turned (N,4)."""
        one = torch.tensor([1.0, 0, 0, 0]).expand(len(xyz), 4)
        return Skin.apply(*self.control.influence(xyz), self.control.rest, *self.pose(t), xyz, one)

    def at_rest(self, xyz: Tensor, t: float) -> Tensor:
        """xyz (N,3) at time t -> about where these points are at rest (N,3)."""
        rest = xyz
        for _ in range(INVERSIONS):
            moved, turned = self.moved(rest, t)
            rest = rest + rotate(conjugate(turned), xyz - moved)
        return rest

    def _expanded(self, xyz: Tensor) -> tuple[Tensor, Tensor]:
        """Places (N,3) as they are moved -> places and scales (N,3) of the scene."""
        if not self.whole:
            return xyz, self.scale
        places, larger = expanded(xyz)
        return places, self.scale * larger

    def _only(self, rows: Tensor) -> DeformingCloud:
        values = {k: v if k == "motion" else v[rows] for k, v in self.values.items()}
        return replace(self, values=values, near=self.near[rows], weight=self.weight[rows])

    @torch.no_grad()
    def to_tracks(self, frames: int, tolerance: float) -> Tracks4D:
        """The cloud as tracks of a clip of so many frames, which they are true to within twice the tolerance, without
        what is there at none of them."""
        times = torch.linspace(-1, 1, frames)
        birth, death = self.values["life"].T[..., None]
        window = torch.stack([(times < birth).sum(1), frames - 1 - (times > death).sum(1)], 1)
        lived = window[:, 0] <= window[:, 1]
        if not lived.all():
            return self._only(lived).to_tracks(frames, tolerance)
        v, control = self.values, self.control
        one = torch.tensor([1.0, 0, 0, 0]).expand(len(self), 4)
        moved = [Skin.apply(self.near, self.weight, control.rest, *self.pose(t), v["xyz"], one) for t in times.tolist()]
        scales = [self._expanded(m[0])[1] for m in moved]
        place = torch.stack([self._expanded(m[0])[0] for m in moved], 1)
        turn = torch.stack([m[1] for m in moved], 1)
        path, offset, rotation, paths = ride(place, turn, window, tolerance)
        return Tracks4D(
            offset=offset,
            scale=scales[len(scales) // 2].clone(),
            rotation=F.normalize(quaternion_multiply(rotation, self.rotation), dim=-1),
            rgb=v["rgb"].clone(),
            opacity=self.opacity.clone(),
            path=path,
            paths=paths,
        )
