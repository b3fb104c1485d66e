# SPDX-License-Identifier: GPL-3.0-or-later
"""An asset at another place in the world: turned, scaled and moved as a whole. numpy only, for inside Blender."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...datagen.sequence import InputError
from .asset import Asset, rotation_matrices
from .paths import Paths
from .pieces import to_pieces


def place_asset(asset: Asset, matrix: np.ndarray) -> Asset:
    """The asset whose clip places it where `matrix` (4,4), from normalised space to the world, would: the
    clip's own scale and translation are replaced. Exact for every matrix that can be inverted: a uniform scale
    and the translation go into the clip, a rotation turns the Gaussians and their paths, and anything else (shear,
    unequal scales, a mirror) makes other Gaussians of them, `softened` before. But where unequal scales would bend
    what turns on a path, the path's `to_pieces` are placed. Raises InputError for a flat one."""
    matrix = np.asarray(matrix, np.float64)
    size = np.cbrt(abs(np.linalg.det(matrix[:3, :3]))) if np.isfinite(matrix).all() else 0
    if size < 1e-9:
        raise InputError("The object is scaled to nothing; give it a scale.")
    A = matrix[:3, :3] / size
    x, y, z = map(float, matrix[:3, 3])
    clip = replace(asset.clip, scale=float(size), translation=(x, y, z))
    if np.abs(A - np.eye(3)).max() < 1e-6:
        return replace(asset, clip=clip)
    rigid = np.abs(A @ A.T - np.eye(3)).max() < 1e-5  # but for a mirror
    if asset.paths is not None and not rigid:
        asset = to_pieces(asset)
    if rigid and np.linalg.det(A) > 0:
        asset = replace(asset, clip=clip, rotation=rotate_quaternions(A, asset.rotation))
    else:
        asset = replace(asset, clip=clip).softened()
        axes, scale, _ = np.linalg.svd(A @ (rotation_matrices(asset.rotation) * asset.scale[:, None, :]))
        axes[np.linalg.det(axes) < 0, :, 2] *= -1  # a Gaussian has no handedness
        asset = replace(asset, scale=scale.astype(np.float32), rotation=quaternions_from_matrices(axes))
    moved = {k: (getattr(asset, k) @ A.T).astype(np.float32) for k in ("xyz", "velocity")}
    paths = None if asset.paths is None else _turned(asset.paths, A)
    return replace(asset, paths=paths, **moved)


def _turned(paths: Paths, A: np.ndarray) -> Paths:
    """Paths as an orthogonal matrix (3,3), a mirror as well, has them: their frames turn about other axes."""
    axis = paths.rotation[:, 1:] @ (np.linalg.det(A) * A.T)
    rotation = np.concatenate([paths.rotation[:, :1], axis], 1)
    return replace(paths, place=(paths.place @ A.T).astype(np.float32), rotation=rotation.astype(np.float32))


def rest_and_motion(matrices: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Where something is at each frame, (F,4,4) into the world, as one place to rest at (4,4) and the motion (F,4,4)
    that leads from there to each of them, None where it stands still. It rests at the first frame's, or, where
    it starts as good as nothing and grows, as soon as it has half of its size. Raises InputError for a flat one."""
    matrices = np.asarray(matrices, np.float64)
    still = np.allclose(matrices, matrices[0], rtol=1e-9, atol=1e-12)
    with np.errstate(over="ignore", invalid="ignore"):
        size = np.abs(np.linalg.det(matrices[:, :3, :3]))
    rest = matrices[int((size >= size.max() / 8).argmax())]
    if not (np.isfinite(matrices).all() and 1e-27 <= size.max() < np.inf):
        raise InputError("The object is scaled to nothing; give it a scale.")
    return rest, None if still else matrices @ np.linalg.inv(rest)


def quaternions_from_matrices(matrices: np.ndarray) -> np.ndarray:
    """(N,3,3) rotation matrices -> (N,4) unit quaternions w x y z, float32."""
    m = matrices
    x, y, z = (m[:, i, i] for i in range(3))
    squares = np.stack([1 + x + y + z, 1 + x - y - z, 1 - x + y - z, 1 - x - y + z], 1)  # 4 q_i²
    a, b, c = (m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1])
    d, e, f = (m[:, 1, 0] + m[:, 0, 1], m[:, 0, 2] + m[:, 2, 0], m[:, 2, 1] + m[:, 1, 2])
    s0, s1, s2, s3 = squares.T
    products = np.stack([s0, a, b, c, a, s1, d, e, b, d, s2, f, c, e, f, s3], 1).reshape(-1, 4, 4)  # 4 q_i q_j
    q = products[np.arange(len(m)), squares.argmax(1)]
    return (q / np.linalg.norm(q, axis=1, keepdims=True)).astype(np.float32)


def rotate_quaternions(rotation: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Unit quaternions q (N,4), w x y z, after the rotation matrix (3,3); float32."""
    w, x, y, z = quaternions_from_matrices(rotation[None])[0].astype(np.float64)
    left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return (q @ left.T).astype(np.float32)
