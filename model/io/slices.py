# SPDX-License-Identifier: GPL-3.0-or-later
"""Moments of a 4D asset for tools that know nothing of time: plain 3DGS .ply and .splat, one or a folder of them;
and an asset at another place in the world. numpy and the standard library only, for inside Blender.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...datagen.sequence import InputError
from .asset import GAUSSIAN_3D, OPACITY_EPS, SH_C0, VISIBLE, Asset, atomic, check, rotation_matrices
from .splat_files import SPLAT, static

# ---------------------------------------------------------------- placing


def placed(asset: Asset, matrix: np.ndarray) -> Asset:
    """The asset whose clip places it where `matrix` (4,4), from normalised space to the world, would: the
    clip's own scale and translation are replaced. Exact for every matrix that can be inverted: a uniform scale
    and the translation go into the clip, a rotation turns the Gaussians, and anything else (shear, unequal
    scales, a mirror) makes other Gaussians of them, `softened` before. Raises InputError for a flat one."""
    matrix = np.asarray(matrix, np.float64)
    size = np.cbrt(abs(np.linalg.det(matrix[:3, :3]))) if np.isfinite(matrix).all() else 0
    if size < 1e-9:
        raise InputError("The object is scaled to nothing; give it a scale.")
    A = matrix[:3, :3] / size
    clip = replace(asset.clip, scale=float(size), translation=tuple(map(float, matrix[:3, 3])))
    if np.abs(A - np.eye(3)).max() < 1e-6:
        return replace(asset, clip=clip)
    if np.abs(A @ A.T - np.eye(3)).max() < 1e-5 and np.linalg.det(A) > 0:
        asset = replace(asset, clip=clip, rotation=_turned(A, asset.rotation))
    else:
        asset = replace(asset, clip=clip).softened()
        axes, scale, _ = np.linalg.svd(A @ (rotation_matrices(asset.rotation) * asset.scale[:, None, :]))
        axes[np.linalg.det(axes) < 0, :, 2] *= -1  # a Gaussian has no handedness
        asset = replace(asset, scale=scale.astype(np.float32), rotation=_quaternions(axes))
    moved = {k: (getattr(asset, k) @ A.T).astype(np.float32) for k in ("xyz", "velocity")}
    return replace(asset, **moved)


def apart(matrices: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
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


def _quaternions(matrices: np.ndarray) -> np.ndarray:
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


def _turned(rotation: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Quaternions q (N,4) after the rotation matrix (3,3)."""
    w, x, y, z = _quaternions(rotation[None])[0].astype(np.float64)
    left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return (q @ left.T).astype(np.float32)


# ---------------------------------------------------------------- writing


def slice_at(asset: Asset, frame: float, cut: float = VISIBLE) -> Asset:
    """What is visible at a (fractional) frame as an asset that does not change, for tools that know nothing of
    time: in world units, with Z turned to -Y, which those take for up; scales are `soft_scale`. Beyond the
    clip's ends it is held, as on the timeline. Where nothing has the opacity `cut` the least faint Gaussian
    stays, because empty files are refused by many."""
    clip = asset.clip
    held = min(max(frame, clip.frame_start), clip.frame_end)
    xyz, opacity = asset.at(clip.frame_to_time(held))
    seen = opacity >= cut
    seen[opacity.argmax()] |= not seen.any()
    world = xyz[seen] * np.float32(clip.scale) + np.array(clip.translation, np.float32)
    down = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], np.float32)  # (x, y, z) -> (x, -z, y)
    return static(
        "the slice",
        xyz=world @ down.T,
        scale=asset.soft_scale()[seen] * np.float32(clip.scale),
        rotation=_turned(down, asset.rotation[seen]),
        rgb=asset.rgb[seen],
        opacity=opacity[seen],
    )


def write_slice(path: str | Path, asset: Asset, frame: float, cut: float = VISIBLE) -> int:
    """Writes `slice_at` as a plain 3DGS .ply or as a .splat, by the suffix; whole or not at all. Returns the
    number of Gaussians. Raises InputError."""
    path = Path(path)
    check(asset, path)
    if np.isnan(frame):
        raise InputError(f"{frame}: the frame must be a number; give one.")
    if path.suffix.lower() not in (".ply", ".splat"):
        raise InputError(f"{path}: the name of a slice must end in .ply or .splat; choose one of these.")
    part = slice_at(asset, frame, cut)
    with atomic(path) as tmp:
        tmp.write_bytes(_splat_bytes(part) if path.suffix.lower() == ".splat" else _ply_bytes(part, frame))
    return len(part)


def write_slices(folder: str | Path, asset: Asset, stem: str) -> int:
    """`write_moments` of every frame of the clip."""
    check(asset, folder)
    return write_moments(folder, ((frame, asset) for frame in asset.clip.frames), stem)


def write_moments(folder: str | Path, moments: Iterable[tuple[int, Asset]], stem: str, cut: float = VISIBLE) -> int:
    """Writes a 3DGS .ply for each (frame, asset) into a new folder, stem_0001.ply and so on by the frame's
    number; the folder appears whole or not at all. Returns the number of files. Raises InputError, also if the
    folder exists and is not empty."""
    folder, count = Path(folder), 0
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise InputError(f"{folder}: it exists already and is not an empty folder; choose another name.")
        with tempfile.TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as tmp:
            whole = Path(tmp) / "frames"
            whole.mkdir()
            for frame, asset in moments:
                count += 1
                (whole / f"{stem}_{frame:04d}.ply").write_bytes(_ply_bytes(slice_at(asset, frame, cut), frame))
            if folder.is_dir():
                folder.rmdir()
            shutil.move(whole, folder)
    except OSError as e:
        raise InputError(f"{folder}: it cannot be written ({e.strerror or e}); choose another place.") from None
    return count


def _ply_bytes(part: Asset, frame: float) -> bytes:
    o = np.clip(part.opacity.astype(np.float64), OPACITY_EPS, 1 - OPACITY_EPS)
    columns = [part.xyz, (part.rgb - 0.5) / SH_C0, np.log(o / (1 - o))[:, None], np.log(part.scale), part.rotation]
    header = ["ply", "format binary_little_endian 1.0", f"comment frame {frame:g} of a 4D asset by Timesplat, -Y is up"]
    header += [f"element vertex {len(part)}", *(f"property float {p}" for p in GAUSSIAN_3D), "end_header", ""]
    return "\n".join(header).encode("ascii") + np.concatenate(columns, 1).astype("<f4").tobytes()


def _splat_bytes(part: Asset) -> bytes:
    """Large and opaque ones first, because viewers show a .splat while it loads."""
    order = np.argsort(-part.scale.prod(1, dtype=np.float64) * part.opacity, kind="stable")
    rows = np.empty(len(part), SPLAT)
    rows["xyz"], rows["scale"] = part.xyz[order], part.scale[order]
    rgba = np.concatenate([part.rgb, part.opacity[:, None]], 1)[order]
    rows["rgba"] = np.round(rgba.clip(0, 1) * 255)
    rows["rotation"] = np.round(part.rotation[order] * 128 + 128).clip(0, 255)
    return rows.tobytes()
