# SPDX-License-Identifier: GPL-3.0-or-later
"""Gaussians4D: a cloud of 4D Gaussians in kinematic form, and its equivalence with the paper's form.

A 4D Gaussian with covariance Σ is the same as a 3D Gaussian that moves on a straight line and glows for a
while: Σ_44 = σ_t², Σ_{1:3,4} = v σ_t², Σ_xyz = Σ_3 + v vᵀ σ_t². At time t it is the 3D Gaussian
(xyz + v (t - μ_t), Σ_3) with opacity o · exp(-½ (t - μ_t)² / σ_t²). (Paper, section 2.1 and appendix A.)
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from .io.asset import Asset, Clip
from .io.pieces import to_pieces
from .rotations import isoclinic_rotation, rotation_matrix, scale_rotation_from_covariance


class DynamicScene(Protocol):
    """A scene whose motion is not that of 4D Gaussians (a deformation field, motion bases)."""

    def at(self, t: float) -> Gaussians4D:
        """The scene at time t in [-1,1], without motion (`frozen`), differentiable."""

    def __len__(self) -> int:
        """How many Gaussians there are."""


class ReconstructedScene(DynamicScene, Protocol):
    """One that a method made of views: what is never seen can be told and left out."""

    def __getitem__(self, index) -> ReconstructedScene:
        """Index or mask of Gaussians."""

    def alive(self) -> Tensor:
        """(N,) bool: whether the paper's inference filters let the Gaussian through at some time of the clip."""

    def to_asset(self, clip: Clip) -> Asset:
        """For files and Blender. Raises InputError where no asset can hold the scene."""


@dataclass
class Gaussians4D:
    """N Gaussians; every field may carry the same leading batch dimensions `…`. Activated, linear values."""

    xyz: Tensor  # (…,N,3) position at its own time `t`, normalised space
    t: Tensor  # (…,N) its own time μ_t, clip = [-1,1]
    velocity: Tensor  # (…,N,3) normalised units per unit of t
    sigma_t: Tensor  # (…,N) lifetime σ_t > 0
    scale: Tensor  # (…,N,3) standard deviations of Σ_3 along its axes, > 0; where there is cov3: see `with_axes`
    rotation: Tensor  # (…,N,4) unit quaternion w x y z of Σ_3's axes; the same
    rgb: Tensor  # (…,N,3) sRGB-encoded colour, 0..1 (not enforced)
    opacity: Tensor  # (…,N) 0..1
    cov3: Tensor | None = None  # (…,N,3,3) Σ_3 where it is what is known (the paper's head), else None

    def __len__(self) -> int:
        return self.xyz.shape[-2]

    def map(self, f) -> Gaussians4D:
        """A new cloud with f applied to every field."""
        values = (getattr(self, k.name) for k in fields(self))
        return Gaussians4D(*(None if v is None else f(v) for v in values))

    def __getitem__(self, index) -> Gaussians4D:
        """Index or mask along the first dimension of every field."""
        return self.map(lambda x: x[index])

    def to(self, *args, **kwargs) -> Gaussians4D:
        return self.map(lambda x: x.to(*args, **kwargs))

    def marginal(self, t: Tensor) -> Tensor:
        """p(t) = exp(-½ (t-μ_t)²/σ_t²), unnormalised. t broadcasts against (…,N)."""
        return torch.exp(-0.5 * ((t - self.t) / self.sigma_t) ** 2)

    def position(self, t: Tensor) -> Tensor:
        """(…,N,3) centres at time t (μ_xyz|t of the paper). t broadcasts against (…,N)."""
        return self.xyz + self.velocity * (t - self.t)[..., None]

    def covariance3(self) -> Tensor:
        """(…,N,3,3) Σ_3, the covariance of the slice at any time."""
        if self.cov3 is not None:
            return self.cov3
        M = rotation_matrix(self.rotation) * self.scale[..., None, :]
        return M @ M.mT

    def covariance4(self) -> Tensor:
        """(…,N,4,4) Σ in the order x y z t."""
        v, s2 = self.velocity, self.sigma_t[..., None] ** 2
        top = self.covariance3() + v[..., :, None] * v[..., None, :] * s2[..., None]
        cross = (v * s2)[..., None]
        return torch.cat([torch.cat([top, cross], -1), torch.cat([cross.mT, s2[..., None]], -1)], -2)

    def widened(self, by: float) -> Gaussians4D:
        """Blurred by a standard deviation of `by`, in every direction."""
        wide = replace(self, scale=(self.scale.square() + by**2).sqrt())
        if self.cov3 is not None:
            wide.cov3 = self.cov3 + by**2 * torch.eye(3).to(self.cov3)
        return wide

    def frozen(self, t: float) -> Gaussians4D:
        """The scene as it is at time t, for ever."""
        return Gaussians4D(
            xyz=self.position(torch.as_tensor(t, dtype=self.xyz.dtype)),
            t=torch.zeros_like(self.t),
            velocity=torch.zeros_like(self.velocity),
            sigma_t=torch.full_like(self.sigma_t, 1e6),
            scale=self.scale,
            rotation=self.rotation,
            rgb=self.rgb,
            opacity=self.opacity * self.marginal(torch.as_tensor(t, dtype=self.xyz.dtype)),
            cov3=self.cov3,
        )

    def alive(self, marginal: float = 0.05, opacity: float = 0.05) -> Tensor:
        """(…,N) bool: whether the paper's inference filters let the Gaussian through at some time of the
        clip: its marginal reaches `marginal` and its weighted opacity `opacity` (appendix A.2)."""
        peak = self.marginal(self.t.clamp(-1, 1))
        return (peak >= marginal) & (self.opacity * peak >= opacity)

    def to_asset(self, clip: Clip) -> Asset:
        """numpy twin for files and Blender; no batch dimensions."""
        axed = self.with_axes()
        arrays = {k: getattr(axed, k).detach().cpu().float().numpy() for k in FIELDS}
        return Asset(**{k: np.ascontiguousarray(a) for k, a in arrays.items()}, clip=clip)

    @staticmethod
    def from_asset(asset: Asset) -> Gaussians4D:
        """Of one whose Gaussians ride on paths: the straight pieces that stand in for it."""
        asset = to_pieces(asset)
        return Gaussians4D(*(torch.from_numpy(getattr(asset, k).copy()) for k in FIELDS))

    @staticmethod
    def from_covariance(xyz, t, velocity, sigma_t, cov3, rgb, opacity) -> Gaussians4D:
        """From Σ_3 (…,N,3,3), which alone is the shape: until `with_axes` is asked for, scale and rotation are those
        of the box around it, without gradient."""
        sides = cov3.detach().diagonal(dim1=-2, dim2=-1).sqrt()
        axes = torch.zeros_like(cov3[..., 0]).detach()
        upright = torch.cat([torch.ones_like(axes[..., :1]), axes], -1)
        return Gaussians4D(xyz, t, velocity, sigma_t, sides, upright, rgb, opacity, cov3)

    def with_axes(self) -> Gaussians4D:
        """The same with scale and rotation for certain and no cov3, as files, fusion and fits need it; without gradient
        where they are derived."""
        if self.cov3 is None:
            return self
        with torch.no_grad():
            scale, rotation = scale_rotation_from_covariance(self.cov3)
        return replace(self, scale=scale, rotation=rotation, cov3=None)

    @staticmethod
    def cat(parts: list[Gaussians4D]) -> Gaussians4D:
        """Joins clouds along N (no batch dimensions)."""
        joined = [torch.cat([getattr(p, k) for p in parts]) for k in FIELDS]
        with_cov3 = any(p.cov3 is not None for p in parts)
        return Gaussians4D(*joined, torch.cat([p.covariance3() for p in parts]) if with_cov3 else None)


FIELDS = [k.name for k in fields(Gaussians4D) if k.name != "cov3"]  # what an Asset holds as well


def kinematic_from_covariance(cov: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """cov (…,4,4) in order x y z t, positive definite -> velocity (…,3), sigma_t (…), Σ_3 (…,3,3)."""
    s2 = cov[..., 3, 3]
    cross = cov[..., :3, 3]
    velocity = cross / s2[..., None]
    return velocity, s2.sqrt(), cov[..., :3, :3] - velocity[..., :, None] * cross[..., None, :]


def paper_from_kinematic(g: Gaussians4D) -> tuple[Tensor, Tensor, Tensor]:
    """-> scale (…,N,4) and the two unit quaternions q_l, q_r (…,N,4) with Σ = R S Sᵀ Rᵀ, for 4DGS tools.

    The eigenvectors of Σ give R in SO(4); its "associate matrix" has rank one and is q_l q_rᵀ (van
    Elfrinkhof), from which both quaternions are read up to a common sign."""
    val, R = torch.linalg.eigh(g.covariance4())
    flip = torch.sign(torch.linalg.det(R))[..., None, None]
    R = torch.cat([R[..., :3], R[..., 3:] * flip], -1)
    # Solve R = L(q_l) R(q_r) = Σ_ij q_l[i] q_r[j] B_ij with the 16 orthogonal basis matrices B_ij (norm 2).
    eye = torch.eye(4, dtype=R.dtype, device=R.device)
    basis = isoclinic_rotation(eye[:, None].expand(4, 4, 4), eye[None].expand(4, 4, 4))  # (4,4,4,4)
    associate = torch.einsum("ijab,...ab->...ij", basis, R) / 4
    U, S, Vh = torch.linalg.svd(associate)
    return val.clamp_min(0).sqrt(), U[..., :, 0], Vh[..., 0, :] * S[..., :1].sign()
