# SPDX-License-Identifier: GPL-3.0-or-later
"""Deformed: canonical 3D Gaussians moved by a HexPlane, the paper's variant "w/ HexPlane" (section 4.2), after
Wu et al. 2024 ("4D-GS").

Six planes of features (xy xz yz xt yt zt) are read at a Gaussian's canonical place and a time; their product
goes through a small MLP, which says how far position, rotation and scale are from the canonical ones. There
the planes are fitted to one scene; here the network decodes them from tokens of their own, and the MLP is the
same for all scenes (network.py). One resolution, where 4D-GS has several.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .gaussians import Gaussians4D
from .heads import ACTIVATIONS
from .layout import Layout

AXES = torch.tensor([[0, 1], [0, 2], [1, 2], [0, 3], [1, 3], [2, 3]])  # of each plane, 3 being time
SIDE = 4  # tokens along a plane's side
CELLS = 8  # cells along a token's
CHANNELS = 16
TOKENS = len(AXES) * SIDE**2
CHANGES = Layout({"xyz": 3, "rotation": 4, "log_scale": 3})  # what the MLP says of a Gaussian at a time


def make_tokens(width: int) -> nn.Parameter:
    """(TOKENS, width) the learned tokens of the planes."""
    return nn.Parameter(torch.randn(TOKENS, width) * 0.02)


def make_decoder(width: int) -> nn.Linear:
    """From tokens of that width to the features of their cells."""
    return nn.Linear(width, CELLS**2 * CHANNELS, bias=False)


def make_mlp() -> nn.Sequential:
    """CHANNELS features -> CHANGES. Starts as no change."""
    layers = [nn.Linear(a, b, bias=False) for a, b in ((CHANNELS, 64), (64, 64), (64, CHANGES.width))]
    nn.init.zeros_(layers[-1].weight)
    return nn.Sequential(layers[0], nn.ReLU(), layers[1], nn.ReLU(), layers[2])


def planes_from_tokens(x: Tensor) -> Tensor:
    """x (TOKENS, CELLS²·CHANNELS) decoded tokens -> planes (6, CHANNELS, R, R), R = SIDE·CELLS, around 1: the
    product of planes that say nothing is 1."""
    x = x.reshape(len(AXES), SIDE, SIDE, CELLS, CELLS, CHANNELS)
    return 1 + x.permute(0, 5, 1, 3, 2, 4).reshape(len(AXES), CHANNELS, SIDE * CELLS, SIDE * CELLS)


def deformed(canonical: Gaussians4D, decoded: Tensor, mlp: nn.Sequential) -> Deformed:
    """N canonical Gaussians, decoded (TOKENS, CELLS²·CHANNELS) the planes' tokens, and the MLP of `make_mlp` -> the
    scene."""
    return Deformed(canonical, planes_from_tokens(decoded), [m.weight for m in mlp if isinstance(m, nn.Linear)])


@dataclass
class Deformed:
    """N Gaussians that a HexPlane moves; see `DynamicScene` in gaussians.py."""

    canonical: Gaussians4D  # (N,) without motion, alive at all times
    planes: Tensor  # (6,C,R,R), rows along a plane's second axis, -1 to 1 from first to last
    weights: list[Tensor]  # of the MLP's layers, (out,in)

    def __len__(self) -> int:
        return len(self.canonical)

    def __getitem__(self, index) -> Deformed:
        """Index or mask of Gaussians."""
        return Deformed(self.canonical[index], self.planes, self.weights)

    def map(self, f) -> Deformed:
        """A new scene with f applied to every tensor."""
        return Deformed(self.canonical.map(f), f(self.planes), [f(w) for w in self.weights])

    def to(self, *args, **kwargs) -> Deformed:
        return self.map(lambda x: x.to(*args, **kwargs))

    @property
    def opacity(self) -> Tensor:
        """(N,) 0..1, at all times."""
        return self.canonical.opacity

    def alive(self, opacity: float = 0.05) -> Tensor:
        """(N,) bool: whether the paper's inference filters let the Gaussian through, at any time (appendix A.2)."""
        return self.canonical.alive(opacity=opacity)

    def at(self, t: float) -> Gaussians4D:
        """The scene at time t in [-1,1], without motion; differentiable."""
        x = self.features(t)
        for w in self.weights[:-1]:
            x = F.relu(F.linear(x, w))
        change = CHANGES.split(F.linear(x, self.weights[-1]))
        return replace(
            self.canonical,
            xyz=self.canonical.xyz + change["xyz"],
            rotation=F.normalize(self.canonical.rotation + change["rotation"], dim=-1),
            scale=(self.canonical.scale * change["log_scale"].exp()).clamp_max(ACTIVATIONS.max_scale),
        )

    def features(self, t: float) -> Tensor:
        """(N,C) product of the six planes, bilinear, at the canonical places; outside of the box its border's."""
        xyz = self.canonical.xyz
        xyzt = torch.cat([xyz, torch.full_like(xyz[:, :1], t)], -1)
        grid = xyzt[:, AXES.to(xyz.device)].transpose(0, 1)[:, None]  # (6,1,N,2)
        read = F.grid_sample(self.planes, grid, padding_mode="border", align_corners=True)  # (6,C,1,N)
        return read[:, :, 0].prod(0).T
