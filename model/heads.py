# SPDX-License-Identifier: GPL-3.0-or-later
"""Heads: from the named outputs of a network to Gaussians (paper, section 2.2 and appendix A.1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from .gaussians import Gaussians4D, kinematic_from_covariance
from .io.asset import SH_C0
from .layout import Layout
from .rotations import isoclinic_rotation, quaternion_multiply

# What defines one Gaussian, in the order of the checkpoints' weights. A group is added here, and used below.
PAPER = Layout({"xyz": 3, "t": 1, "rgb": 3, "scale": 3, "scale_t": 1, "q_l": 4, "q_r": 4, "opacity": 1})
KINEMATIC = Layout({"xyz": 3, "t": 1, "rgb": 3, "scale": 3, "scale_t": 1, "rotation": 4, "velocity": 3, "opacity": 1})
STILL = Layout({"xyz": 3, "rgb": 3, "scale": 3, "rotation": 4, "opacity": 1})  # of a HexPlane, which moves it
ABSOLUTE = {"paper": PAPER, "kinematic": KINEMATIC}  # by head

# The same as corrections to a known Gaussian; either head corrects its kinematic form, and leaves some outputs unused.
_SAME = {"xyz": 3, "t": 1, "rgb": 3, "scale": 3, "scale_t": 1, "unused": 1, "turn": 3, "velocity": 3}
RESIDUAL = {
    "paper": Layout({**_SAME, "unused_too": 1, "opacity": 1}),
    "kinematic": Layout({**_SAME, "opacity": 1}),
}


@dataclass(frozen=True)
class Activations:
    """The appendix's biases and clamps."""

    log_scale: float = -2.3  # where outputs are 0, also of σ_t
    opacity_logit: float = -2.0
    max_scale: float = 0.3  # σ
    max_scale_t: float = 1.0  # σ_t
    near: float = 0.1  # the paper's range of the distance along a ray
    far: float = 4.5
    half_range: float = 1.8  # of the centred range, to either side of the ray's point closest to the origin


ACTIVATIONS = Activations()


def activate(outputs: dict[str, Tensor]) -> Gaussians4D:
    """The outputs (…,n) of PAPER, KINEMATIC or STILL, split -> Gaussians (…,) with the appendix's activations and
    biases. Those of STILL do not move, and live for ever. The paper head's shape is in `cov3`."""
    a, xyz = ACTIVATIONS, outputs["xyz"]
    rgb = 0.5 + SH_C0 * outputs["rgb"]
    scale = torch.exp(outputs["scale"] + a.log_scale).clamp_max(a.max_scale)
    opacity = torch.sigmoid(outputs["opacity"] + a.opacity_logit)
    if "rotation" in outputs:
        rotation = F.normalize(outputs["rotation"] + outputs["rotation"].new_tensor([1.0, 0, 0, 0]), dim=-1)
    if "t" not in outputs:
        zero = torch.zeros_like(opacity)
        return Gaussians4D(xyz, zero, torch.zeros_like(xyz), zero + 1e6, scale, rotation, rgb, opacity)
    scale_t = torch.exp(outputs["scale_t"] + a.log_scale).clamp_max(a.max_scale_t)
    if "velocity" in outputs:
        return Gaussians4D(xyz, outputs["t"], outputs["velocity"], scale_t, scale, rotation, rgb, opacity)
    R = isoclinic_rotation(F.normalize(outputs["q_l"], dim=-1), F.normalize(outputs["q_r"], dim=-1))
    M = R * torch.cat([scale, scale_t[..., None]], -1)[..., None, :]
    velocity, sigma_t, cov3 = kinematic_from_covariance(M @ M.mT)
    return Gaussians4D.from_covariance(xyz, outputs["t"], velocity, sigma_t, cov3, rgb, opacity)


def along_rays(
    outputs: dict[str, Tensor], origin: Tensor, direction: Tensor, depth_range: Literal["paper", "centred"]
) -> Gaussians4D:
    """The outputs of N Gaussians, as in `activate`, origin and unit direction (N,3) -> Gaussians on their rays."""
    a = ACTIVATIONS
    omega = torch.sigmoid(outputs["xyz"].mean(-1, keepdim=True))
    if depth_range == "paper":
        distance = a.near * (1 - omega) + a.far * omega
    else:
        distance = (2 * omega - 1) * a.half_range - (origin * direction).sum(-1, keepdim=True)
    g = activate(outputs)
    g.xyz = origin + distance * direction
    return g


def in_the_box(outputs: dict[str, Tensor]) -> Gaussians4D:
    """The outputs of N Gaussians, as in `activate` -> Gaussians with centres anywhere in the box and the clip."""
    g = activate(outputs)
    g.xyz, g.t = torch.tanh(g.xyz), torch.tanh(g.t)
    return g


def corrected(outputs: dict[str, Tensor], base: Gaussians4D, direction: Tensor, max_shift: Tensor) -> Gaussians4D:
    """The outputs of M corrections (RESIDUAL), the Gaussians (M,) that they are to, their rays' directions (M,3) and
    max_shift (M,) -> base plus bounded steps: along the ray by max_shift, σ and σ_t by a factor of e^1.5, colour by
    0.5, velocity by 4 per unit of time, μ_t by 0.3, opacity by 4 in its logit. Outputs of 0 change nothing."""
    shift = max_shift[..., None] * torch.tanh(outputs["xyz"].mean(-1, keepdim=True))
    turn = torch.cat([torch.ones_like(shift), 0.5 * outputs["turn"]], -1)
    return Gaussians4D(
        xyz=base.xyz + shift * direction,
        t=base.t + 0.3 * torch.tanh(outputs["t"]),
        velocity=base.velocity + 4 * torch.tanh(0.25 * outputs["velocity"]),
        sigma_t=base.sigma_t * torch.exp(1.5 * torch.tanh(outputs["scale_t"])),
        scale=base.scale * torch.exp(1.5 * torch.tanh(outputs["scale"])),
        rotation=quaternion_multiply(base.rotation, F.normalize(turn, dim=-1)),
        rgb=base.rgb + 0.5 * torch.tanh(outputs["rgb"]),
        opacity=torch.sigmoid(torch.logit(base.opacity, 1e-4) + 4 * torch.tanh(0.5 * outputs["opacity"])),
    )
