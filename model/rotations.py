# SPDX-License-Identifier: GPL-3.0-or-later
"""Rotations in three and four dimensions: quaternions, matrices, and the axes of covariances."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import normalize


def rotation_matrix(q: Tensor) -> Tensor:
    """q (…,4) unit quaternions w x y z -> (…,3,3) rotation matrices."""
    w, x, y, z = q.unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def quaternion_from_matrix(R: Tensor) -> Tensor:
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
    return normalize(row, dim=-1)


def quaternion_multiply(a: Tensor, b: Tensor) -> Tensor:
    """a, b (…,4) quaternions w x y z -> (…,4) their product: the rotation first by b, then by a."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        -1,
    )


def conjugate(q: Tensor) -> Tensor:
    """The inverse of unit quaternions (…,4)."""
    return q * q.new_tensor([1.0, -1, -1, -1])


def rotate(q: Tensor, v: Tensor) -> Tensor:
    """q (…,4) unit quaternions, v (…,3) -> (…,3) v turned by them."""
    u = q[..., 1:]
    side = 2 * torch.linalg.cross(u, v)
    return v + q[..., :1] * side + torch.linalg.cross(u, side)


def isoclinic_rotation(q_l: Tensor, q_r: Tensor) -> Tensor:
    """q_l, q_r (…,4) unit quaternions -> (…,4,4) rotations L(q_l) R(q_r) of x y z t, exactly as the paper prints
    them (appendix A.1). Its R(q_r) is the transpose of the matrix in the 4DGS code."""
    a, b, c, d = q_l.unbind(-1)
    p, q, r, s = q_r.unbind(-1)
    L = torch.stack([a, -b, -c, -d, b, a, -d, c, c, d, a, -b, d, -c, b, a], -1).unflatten(-1, (4, 4))
    R = torch.stack([p, -q, -r, -s, q, p, s, -r, r, -s, p, q, s, r, -q, p], -1).unflatten(-1, (4, 4))
    return L @ R


def scale_rotation_from_covariance(cov3: Tensor) -> tuple[Tensor, Tensor]:
    """cov3 (…,3,3) symmetric positive -> scale (…,3) ascending, rotation (…,4). By `eigh3`, in float64, and not for
    gradients, which are infinite for equal eigenvalues: training goes through `Gaussians4D.covariance3` instead."""
    val, vec = eigh3(cov3.double())
    return val.clamp_min(1e-14).sqrt().to(cov3.dtype), quaternion_from_matrix(vec).to(cov3.dtype)


def eigh3(A: Tensor) -> tuple[Tensor, Tensor]:
    """A (…,3,3) symmetric -> eigenvalues (…,3) ascending, eigenvectors (…,3,3) in columns, of determinant +1. In closed
    form, so that it is the same few operations for any number of matrices on any device, where torch.linalg.eigh takes
    a quarter of a forward pass and is reported to fail on CUDA for large batches.

    The eigenvalue farthest from the other two is the stable root of the cubic (Smith 1961); its vector is the longest
    cross product of two rows of A - λ, and what is left is a 2x2 problem in the plane across it, solved by its angle:
    equal eigenvalues do no harm (after Eberly, "A Robust Eigensolver for 3x3 Symmetric Matrices", 2014)."""
    size = A.abs().amax((-2, -1)).clamp_min(torch.finfo(A.dtype).tiny)
    A = A / size[..., None, None]
    eye = torch.eye(3, dtype=A.dtype, device=A.device)
    mean = A.diagonal(dim1=-2, dim2=-1).mean(-1)
    B = A - mean[..., None, None] * eye
    p = (B.square().sum((-2, -1)) / 6).sqrt()
    half_det = (0.5 * _det3(B / p.clamp_min(1e-150)[..., None, None])).clamp(-1, 1)
    angle = torch.acos(half_det) / 3
    largest = half_det >= 0  # whether the one apart is the largest, else it is the smallest
    root = torch.where(largest, 2 * torch.cos(angle), 2 * torch.cos(angle + 2 * math.pi / 3))
    rows = B - (p * root)[..., None, None] * eye
    crosses = torch.linalg.cross(rows[..., [0, 0, 1], :], rows[..., [1, 2, 2], :])
    best = crosses.square().sum(-1).argmax(-1)
    apart = crosses.gather(-2, best[..., None, None].expand(*best.shape, 1, 3)).squeeze(-2)
    length = apart.norm(dim=-1, keepdim=True)
    apart = torch.where(length > 1e-100, apart / length.clamp_min(1e-150), eye[2])  # a ball has no axes
    # Two unit vectors across it, the first from the coordinate axis that it is farthest from.
    u = torch.linalg.cross(apart, eye[apart.abs().argmin(-1)])
    u = u / u.norm(dim=-1, keepdim=True)
    v = torch.linalg.cross(apart, u)
    Au, Av = (B @ u[..., None])[..., 0], (B @ v[..., None])[..., 0]
    a, b, c = (u * Au).sum(-1), (u * Av).sum(-1), (v * Av).sum(-1)
    turn = 0.5 * torch.atan2(2 * b, a - c)[..., None]
    major = torch.cos(turn) * u + torch.sin(turn) * v
    minor = torch.linalg.cross(apart, major)
    values = torch.stack([(x * (B @ x[..., None])[..., 0]).sum(-1) for x in (minor, major, apart)], -1)
    # minor <= major; the one apart comes last if it is the largest, else first.
    last, first = (torch.tensor(x, device=A.device) for x in ([0, 1, 2], [2, 0, 1]))
    order = torch.where(largest[..., None], last, first)
    vectors = torch.stack([minor, major, apart], -1)
    vectors = vectors.gather(-1, order[..., None, :].expand(vectors.shape))
    values = (values.gather(-1, order) + mean[..., None]) * size[..., None]
    return values, vectors * _det3(vectors).sign()[..., None, None]


def _det3(A: Tensor) -> Tensor:
    return (A[..., 0, :] * torch.linalg.cross(A[..., 1, :], A[..., 2, :])).sum(-1)
