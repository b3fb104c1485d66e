# SPDX-License-Identifier: GPL-3.0-or-later
"""A method like Shape of Motion (Wang et al. 2024): one canonical cloud of 3D Gaussians, moved by a few
rigid motions over time, of which every Gaussian has its own blend; fitted to one scene's photographs.

As there: rigid bases given per moment, blended by every Gaussian's softmax, k-means to begin with, and losses on
colour, mask, rigidity and the bases' acceleration. Otherwise than there, where one casual video comes with
monocular depth and long 2D tracks that start the bases and go on guiding them: here cameras stand all around
and there are neither, so canonical points come from our sweep's depths in the views nearest to the middle of
the clip, all bases start at rest, and nothing but the pictures tells what moves. Rotations are quaternions,
cheaper here than 6D frames, bases are smoothed over neighbouring moments, and there is no
densification.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from ...datagen.sequence import InputError
from ..fitting.fit_views import detached, downsampled, reduction
from ..fitting.loop import COARSE, Schedule, Step, gradients, optimise, photometric_loss
from ..fitting.parameters import Parameters
from ..gaussians import Gaussians4D
from ..geometry.plane_sweep import sweep_geometry
from ..io.asset import Clip
from ..parallel import work_clock
from ..rotations import quaternion_multiply, rotate
from ..views import Views
from .visual_hull import white

POINTS = 2500
BASES = 10
WINDOW = 8  # views nearest to the middle of the clip, whose points are the canonical ones
OPACITY = 0.5  # at the start
WIDTH = 1.5  # σ in frames of the bases' smoothing over time
ANCHORS = 512  # Gaussians whose distances to their six nearest are kept
ACCELERATION, RIGID = 1.0, 1.0  # weights in the loss
# Learning rates at the start and at the end, of the raw parameters.
RATES = {
    "xyz": (2e-3, 2e-4),
    "scale": (2e-2, 5e-3),
    "rotation": (1e-2, 2e-3),
    "rgb": (2e-2, 4e-3),
    "opacity": (5e-2, 1e-2),
    "blend": (5e-2, 1e-2),
    "bases": (2e-2, 2e-3),
}


@dataclass
class Motion:
    """N canonical Gaussians and K rigid motions given at M moments, linear between. A `DynamicScene`."""

    gaussians: Gaussians4D  # (N,) canonical, without motion of their own
    blend: Tensor  # (N,K) shares of the bases, of sum 1
    moments: Tensor  # (M,) model times, ascending
    bases: Tensor  # (M,K,7) quaternion w x y z of any length, translation

    def at(self, t: float) -> Gaussians4D:
        """The scene at time t; before the first moment as at the first, after the last as at the last."""
        here = self.moments
        b = int((here <= t).sum().clamp(1, len(here) - 1)) if len(here) > 1 else 0
        a = max(b - 1, 0)
        w = min(max((t - float(here[a])) / max(float(here[b] - here[a]), 1e-9), 0.0), 1.0)
        return self.pose(torch.lerp(self.bases[a], self.bases[b], w))

    def pose(self, bases: Tensor) -> Gaussians4D:
        """The scene moved by K bases (K,7)."""
        g = self.gaussians
        xyz, turn = moved(g.xyz, self.blend @ bases)
        return replace(g, xyz=xyz, rotation=quaternion_multiply(turn, g.rotation))

    def __len__(self) -> int:
        return len(self.gaussians)

    def __getitem__(self, index) -> Motion:
        """Index or mask over the N Gaussians; the bases stay."""
        return replace(self, gaussians=self.gaussians[index], blend=self.blend[index])

    def alive(self) -> Tensor:
        """See `Gaussians4D.alive`."""
        return self.gaussians.alive()

    def to(self, *args, **kwargs) -> Motion:
        return Motion(*(x.to(*args, **kwargs) for x in vars(self).values()))

    def to_asset(self, clip: Clip):
        """Raises InputError: paths are not straight, so this is no 4D Gaussian asset."""
        raise InputError("som: its Gaussians do not move on straight lines, so no asset can hold them; evaluate it.")


def moved(xyz: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
    """Points (…,3) and the blended bases (…,7) of each -> the points moved, and the unit quaternions (…,4)."""
    turn = F.normalize(pose[..., :4], dim=-1)
    return rotate(turn, xyz) + pose[..., 4:], turn


def clusters(points: Tensor, count: int, generator) -> Tensor:
    """points (N,3) -> centres (count,3) by k-means."""
    centre = points[torch.randperm(len(points), generator=generator)[:count]]
    for _ in range(10):
        label = torch.cdist(points, centre).argmin(1)
        total = torch.zeros_like(centre).index_add_(0, label, points)
        n = torch.bincount(label, minlength=len(centre))[:, None]
        centre = torch.where(n > 0, total / n.clamp_min(1), centre)
    return centre


def shape_of_motion(
    views: Views,
    device: str = "cpu",
    seconds: float = 10.0,
    steps: int | None = None,
    seed: int = 0,
    max_gaussians: int = POINTS,
    progress=None,
) -> Motion | Gaussians4D:
    """Views (RGB and alpha alone are used) -> Motion of POINTS, or `max_gaussians` if that is less, on the CPU, after
    `seconds`, or `steps` where given; where no view shows the object, nothing (`white`). For `progress` see
    `optimise`."""
    start = work_clock()
    with gradients():
        views = detached(views)
        generator = torch.Generator().manual_seed(seed)
        g = canonical(views, generator)[:max_gaussians]
        if not len(g):
            return white(views)
        moments = views.time.unique()
        raw = starting_point(g, len(moments), generator)
        p = Parameters({k: x.to(device) for k, x in raw.items()}, RATES)
        moments, views = moments.to(device), views.to(device)
        smooth = torch.exp(-0.5 * ((moments[:, None] - moments) / (WIDTH * views.frame_step)) ** 2)
        smooth = smooth / smooth.sum(1, keepdim=True)
        rigidity = Rigidity(g.xyz, device, generator)

        def loss(step: Step) -> Tensor:
            bases = step.scene.bases
            out = photometric_loss(step)
            if len(bases) > 2:
                out = out + ACCELERATION * (bases[2:] - 2 * bases[1:-1] + bases[:-2]).square().mean()
            # At a moment at random, neighbours keep their distance.
            pose = step.scene.blend @ bases[int(torch.randint(len(bases), (), generator=generator))]
            return out + RIGID * rigidity.loss(p["xyz"], moved(p["xyz"], pose)[0])

        optimise(
            p,
            lambda: activate(p.values, moments, smooth),
            views,
            loss,
            Schedule(seconds=seconds - (work_clock() - start), steps=steps, seed=seed),
            generator=generator,
            text="som",
            progress=progress,
        )
        return activate({k: x.detach() for k, x in p.values.items()}, moments, smooth).to("cpu")


def starting_point(g: Gaussians4D, moments: int, generator: torch.Generator) -> dict[str, Tensor]:
    """Raw parameters of the canonical Gaussians (N,) and of BASES (fewer, where there are fewer Gaussians) at rest at
    so many moments, each Gaussian with most of the bases whose cluster it lies next to."""
    centre = clusters(g.xyz, min(BASES, len(g)), generator)
    away = torch.cdist(g.xyz, centre).square()
    return {
        "xyz": g.xyz,
        "scale": g.scale.log(),
        "rotation": g.rotation,
        "rgb": g.rgb,
        "opacity": g.opacity.logit(),
        "blend": -away / away.amin(1).mean().clamp_min(1e-6),
        "bases": 1e-3 * torch.randn(moments, len(centre), 7, generator=generator),
    }


class Rigidity:
    """Distances of ANCHORS, chosen among points (N,3) at random, to their six nearest neighbours."""

    def __init__(self, points: Tensor, device: str, generator: torch.Generator):
        anchors = torch.randperm(len(points), generator=generator)[:ANCHORS]
        count = min(7, len(points))
        nearest = torch.cdist(points[anchors], points).topk(count, largest=False).indices[:, 1:]
        self.anchors, self.nearest = anchors.to(device), nearest.to(device)

    def distances(self, xyz: Tensor) -> Tensor:
        """(A,6) of the points as they are at xyz (N,3)."""
        return (xyz[self.nearest] - xyz[self.anchors][:, None]).square().sum(-1).add(1e-12).sqrt()

    def loss(self, before: Tensor, after: Tensor) -> Tensor:
        """() mean square of how much the distances differ between two states of the points (N,3)."""
        rest, now = self.distances(before), self.distances(after)
        return (now - rest).square().mean()


def canonical(views: Views, generator: torch.Generator) -> Gaussians4D:
    """POINTS of the sweep's points (all, where there are fewer) in the WINDOW views nearest to the middle of the
    clip that show the object, round, unmoving, larger for being fewer."""
    shown = (views.alpha.flatten(1).amax(1) > 0.5).nonzero()[:, 0]
    views = downsampled(views[shown], reduction(views, COARSE))
    middle = views.time.sort().values[len(views) // 2] if len(views) else 0.0
    closest = views[(views.time - middle).abs().argsort(stable=True)[:WINDOW]]
    if not len(closest):
        return white(views)
    g = sweep_geometry(closest).gaussians
    chosen = torch.randperm(len(g), generator=generator)[:POINTS]
    grow = 0.7 * (len(g) / max(len(chosen), 1)) ** 0.5
    g = g[chosen].frozen(0.0)
    g.scale = grow * g.scale.amax(-1, keepdim=True).expand(-1, 3)
    g.opacity = torch.full_like(g.opacity, OPACITY)
    return g


def activate(raw: dict[str, Tensor], moments: Tensor, smooth: Tensor) -> Motion:
    """Raw parameters -> the scene; smooth (M,M) mixes the bases of neighbouring moments, so that what one
    view teaches about a moment moves the moments around it as well."""
    n = len(raw["xyz"])
    g = Gaussians4D(
        xyz=raw["xyz"],
        t=raw["xyz"].new_zeros(n),
        velocity=raw["xyz"].new_zeros(n, 3),
        sigma_t=raw["xyz"].new_full((n,), 1e6),
        scale=raw["scale"].exp(),
        rotation=F.normalize(raw["rotation"], dim=-1),
        rgb=raw["rgb"],
        opacity=torch.sigmoid(raw["opacity"]),
    )
    rest = raw["bases"].new_tensor([1.0, 0, 0, 0, 0, 0, 0])
    bases = rest + torch.einsum("mn,nkc->mkc", smooth, raw["bases"])
    return Motion(g, raw["blend"].softmax(-1), moments, bases)
