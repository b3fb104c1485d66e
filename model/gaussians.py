# SPDX-License-Identifier: GPL-3.0-or-later
"""Gaussians4D: a cloud of 4D Gaussians in kinematic form, and its equivalence with the paper's form.

A 4D Gaussian with covariance Σ is the same as a 3D Gaussian that moves on a straight line and glows for a
while: Σ_44 = σ_t², Σ_{1:3,4} = v σ_t², Σ_xyz = Σ_3 + v vᵀ σ_t². At time t it is the 3D Gaussian
(xyz + v (t - μ_t), Σ_3) with opacity o · exp(-½ (t - μ_t)² / σ_t²). (Paper, section 2.1 and appendix A.)
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from .asset import Asset, Clip


class Moving(Protocol):
    """A scene whose motion is not that of 4D Gaussians (a deformation field, motion bases)."""

    def at(self, t: float) -> Gaussians4D:
        """The scene at time t in [-1,1], without motion (`frozen`), differentiable."""

    def __len__(self) -> int:
        """How many Gaussians there are."""


@dataclass
class Gaussians4D:
    """N Gaussians; every field may carry the same leading batch dimensions `…`. Activated, linear values."""

    xyz: Tensor  # (…,N,3) position at its own time `t`, normalised space
    t: Tensor  # (…,N) its own time μ_t, clip = [-1,1]
    velocity: Tensor  # (…,N,3) normalised units per unit of t
    sigma_t: Tensor  # (…,N) lifetime σ_t > 0
    scale: Tensor  # (…,N,3) standard deviations of Σ_3 along its axes, > 0
    rotation: Tensor  # (…,N,4) unit quaternion w x y z of Σ_3's axes
    rgb: Tensor  # (…,N,3) sRGB-encoded colour, 0..1 (not enforced)
    opacity: Tensor  # (…,N) 0..1
    cov3: Tensor | None = None  # (…,N,3,3) Σ_3 where gradients must reach it (the paper's head), else None

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
        arrays = {k: getattr(self, k).detach().cpu().float().numpy() for k in FIELDS}
        return Asset(**{k: np.ascontiguousarray(a) for k, a in arrays.items()}, clip=clip)

    @staticmethod
    def from_asset(asset: Asset) -> Gaussians4D:
        return Gaussians4D(*(torch.from_numpy(getattr(asset, k).copy()) for k in FIELDS))

    @staticmethod
    def from_covariance(xyz, t, velocity, sigma_t, cov3, rgb, opacity) -> Gaussians4D:
        """From Σ_3 (…,N,3,3) instead of scale and rotation, which are derived without gradient."""
        with torch.no_grad():
            scale, rotation = scale_rotation_from_covariance(cov3)
        return Gaussians4D(xyz, t, velocity, sigma_t, scale, rotation, rgb, opacity, cov3)

    @staticmethod
    def cat(parts: list[Gaussians4D]) -> Gaussians4D:
        """Joins clouds along N (no batch dimensions)."""
        joined = [torch.cat([getattr(p, k) for p in parts]) for k in FIELDS]
        with_cov3 = any(p.cov3 is not None for p in parts)
        return Gaussians4D(*joined, torch.cat([p.covariance3() for p in parts]) if with_cov3 else None)


FIELDS = [k.name for k in fields(Gaussians4D) if k.name != "cov3"]  # what an Asset holds as well


def rotation_matrix(q: Tensor) -> Tensor:
    """q (…,4) unit quaternions w x y z -> (…,3,3) rotation matrices."""
    w, x, y, z = q.unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def quaternion(R: Tensor) -> Tensor:
    """R (…,3,3) rotation matrices -> (…,4) unit quaternions w x y z, the largest component positive.

    The row of 4·q·qᵀ with the largest diagonal is taken, which is exact and stable for every rotation."""
    m = R.flatten(-2).unbind(-1)
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = m
    K = torch.stack(
        [
            1 + m00 + m11 + m22, m21 - m12, m02 - m20, m10 - m01,
            m21 - m12, 1 + m00 - m11 - m22, m01 + m10, m02 + m20,
            m02 - m20, m01 + m10, 1 - m00 + m11 - m22, m12 + m21,
            m10 - m01, m02 + m20, m12 + m21, 1 - m00 - m11 + m22,
        ],
        -1,
    ).unflatten(-1, (4, 4))  # fmt: skip
    best = K.diagonal(dim1=-2, dim2=-1).argmax(-1)
    row = K.gather(-2, best[..., None, None].expand(*best.shape, 1, 4)).squeeze(-2)
    return torch.nn.functional.normalize(row, dim=-1)


# ---------------------------------------------------------------- the paper's form


def isoclinic_rotation(q_l: Tensor, q_r: Tensor) -> Tensor:
    """R = L(q_l) R(q_r), (…,4,4), from unit quaternions (…,4), exactly as the paper prints them (appendix
    A.1). Note that its R(q_r) is the transpose of the matrix in the 4DGS code."""
    a, b, c, d = q_l.unbind(-1)
    p, q, r, s = q_r.unbind(-1)
    L = torch.stack([a, -b, -c, -d, b, a, -d, c, c, d, a, -b, d, -c, b, a], -1).unflatten(-1, (4, 4))
    R = torch.stack([p, -q, -r, -s, q, p, s, -r, r, -s, p, q, s, r, -q, p], -1).unflatten(-1, (4, 4))
    return L @ R


def kinematic_from_covariance(cov: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """cov (…,4,4) in order x y z t, positive definite -> velocity (…,3), sigma_t (…), Σ_3 (…,3,3)."""
    s2 = cov[..., 3, 3]
    cross = cov[..., :3, 3]
    velocity = cross / s2[..., None]
    return velocity, s2.sqrt(), cov[..., :3, :3] - velocity[..., :, None] * cross[..., None, :]


def scale_rotation_from_covariance(cov3: Tensor) -> tuple[Tensor, Tensor]:
    """cov3 (…,3,3) symmetric positive -> scale (…,3) ascending, rotation (…,4). By eigen-decomposition, whose
    gradient is infinite for equal eigenvalues: training goes through `Gaussians4D.covariance3` instead."""
    val, vec = torch.linalg.eigh(cov3)
    vec = vec * torch.sign(torch.linalg.det(vec))[..., None, None]
    return val.clamp_min(1e-14).sqrt(), quaternion(vec)


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
