# SPDX-License-Identifier: GPL-3.0-or-later
"""A 4D Gaussian asset as arrays. numpy only, so that it runs inside Blender."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...datagen.sequence import InputError
from .paths import Paths, inverse, multiply, rotate

SH_C0 = 0.28209479177387814  # the constant spherical harmonic: rgb = 0.5 + SH_C0 * f_dc
VISIBLE = 0.05  # opacity below which a Gaussian counts as invisible at a moment (the paper's filter)
STATIC_SIGMA_T = 1e4  # lifetime of what does not change: exp(-½(2/1e4)²) is 1 in float32
ONE_FRAME_SIGMA = 1 / 3  # σ_t, in frames, of what shows at one frame: 1.1 % of its opacity is left a frame away
SCREEN_BLUR = 0.1  # px² that rasterisers of splats add to the covariance on the screen
SMALLEST_SCALE = 1e-9  # other programs' splats are at least so large
FAR = 256  # times its size (or units, what is smaller than one) away from the origin, float32 costs 1e-5 of that
BRIGHTEST = 1e6  # colours beyond are damage; as coefficients they would be infinite
FARTHEST_KNOT = 1e15  # of a path, from the origin: what rides on it is turned, and squares must stay finite
MAX_GAUSSIANS = 10_000_000  # that a compressed file or a sequence may hold, as in Niantic's reader
MAX_CLIP_FRAMES = 50_000  # more than half an hour
MAX_FRAME_NUMBER = 1 << 20  # as far as Blender counts


@dataclass(frozen=True)
class Clip:
    """What leads from the asset's normalised space and time back to the scene it was made from."""

    fps: float = 24.0
    frame_start: int = 0
    frame_end: int = 23  # inclusive; model time -1 is frame_start, +1 is frame_end
    scale: float = 1.0  # world = scale * normalised + translation
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    pixel: float = 0.0  # size at the object of a pixel of the pictures it was made from; 0 = not known

    def frame_to_time(self, frame):
        """Model time of a (fractional) frame number or array of them; 0 where the clip is one frame."""
        if self.frame_end == self.frame_start:
            return np.zeros_like(frame, dtype=float)[()]
        return 2 * (np.asarray(frame, float) - self.frame_start)[()] / (self.frame_end - self.frame_start) - 1

    @property
    def frames(self) -> range:
        """Every frame number of the clip, both ends included."""
        return range(self.frame_start, self.frame_end + 1)


@dataclass
class Asset:
    """N 4D Gaussians in kinematic form (see model/gaussians.py), all arrays float32, linear values.

    Where there are `paths`, each rides on one of them: place and rotation at any other time follow from those at its
    own time `t` by the path's, its velocity is that of then, and it is there as long as its path says, with a lifetime
    that knows no end (STATIC_SIGMA_T)."""

    xyz: np.ndarray  # (N,3) position at its own time, normalised space
    t: np.ndarray  # (N,) its own time, clip = [-1,1]
    velocity: np.ndarray  # (N,3) normalised units per unit of t
    sigma_t: np.ndarray  # (N,) > 0
    scale: np.ndarray  # (N,3) standard deviations, > 0
    rotation: np.ndarray  # (N,4) unit quaternion w x y z
    rgb: np.ndarray  # (N,3) sRGB-encoded, 0..1
    opacity: np.ndarray  # (N,) 0..1
    clip: Clip = field(default_factory=Clip)
    path: np.ndarray | None = None  # (N,) int32, the row of `paths` that each rides on
    paths: Paths | None = None

    def __len__(self) -> int:
        return len(self.xyz)

    def __getitem__(self, rows: np.ndarray) -> Asset:
        """The Gaussians of these indices or this mask; paths that nothing rides on any more are left out."""
        arrays = {name: getattr(self, name)[rows] for name in ARRAYS}
        if self.paths is None:
            return replace(self, **arrays)
        paths, path = self.riding()
        used, index = np.unique(path[rows], return_inverse=True)
        return replace(self, **arrays, path=index.astype(np.int32).reshape(-1), paths=paths[used])

    def at(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Positions (N,3) in normalised space and opacities (N,) 0..1 at a model time (-1..1 over the clip,
        any fraction; times outside continue the lines, and paths stay at their ends)."""
        dt = np.float32(time) - self.t
        with np.errstate(under="ignore", over="ignore"):
            opacity = self.opacity * np.exp(-0.5 * (dt / self.sigma_t) ** 2)
            if self.paths is None:
                return self.xyz + self.velocity * dt[:, None], opacity
        paths, path = self.riding()
        place, turn = paths.at(time, path)
        offset, _ = self.on_path()
        return place + rotate(turn, offset), opacity * paths.there(time)[path]

    def rotation_at(self, time: float) -> np.ndarray:
        """(N,4) the rotations at a model time: without paths they do not change."""
        if self.paths is None:
            return self.rotation
        return multiply(self.paths.at(time, self.path)[1], self.on_path()[1])

    def riding(self) -> tuple[Paths, np.ndarray]:
        """Where there are paths: those, and the row (N,) of them that each Gaussian rides on."""
        assert self.paths is not None and self.path is not None
        return self.paths, self.path

    def on_path(self) -> tuple[np.ndarray, np.ndarray]:
        """Where there are paths: offsets (N,3) and rotations (N,4) in the moving frames, which do not change."""
        paths, path = self.riding()
        place, turn = paths.at(self.t, path)
        return rotate(inverse(turn), self.xyz - place), multiply(inverse(turn), self.rotation)

    def path_velocity(self) -> np.ndarray:
        """(N,3) where there are paths: velocities at their own times, of the half frames before and after together."""
        (paths, path), (offset, _) = self.riding(), self.on_path()
        half = np.float32(1 / max(self.clip.frame_end - self.clip.frame_start, 1))
        before = np.maximum(self.t - half, np.minimum(self.t, paths.start[path]))
        after = np.minimum(self.t + half, np.maximum(self.t, paths.end[path]))
        (place, turn), (later, turned) = (paths.at(time, path) for time in (before, after))
        way = later + rotate(turned, offset) - place - rotate(turn, offset)
        return way / np.maximum(after - before, np.float32(1e-9))[:, None]

    def frame_to_time(self, frame):
        """Model time of a (fractional) frame number of the clip: frame_start is -1, frame_end is +1."""
        return self.clip.frame_to_time(frame)

    def soft_scale(self) -> np.ndarray:
        """(N,3) standard deviations as they looked in the pictures that the asset was fitted to, where the
        rasteriser blurred by SCREEN_BLUR px². Renderers which do not, or at a higher resolution, show holes
        between Gaussians with the plain `scale`. Equal to it where clip.pixel is 0."""
        # not by squares, which are 0 or infinite long before their roots are
        return np.hypot(self.scale, np.float32(SCREEN_BLUR**0.5 * self.clip.pixel))

    def softened(self) -> Asset:
        """The same with `soft_scale` for good (clip.pixel 0), for viewers that know nothing of pixels."""
        return replace(self, scale=self.soft_scale(), clip=replace(self.clip, pixel=0.0))


ARRAYS = tuple(f.name for f in fields(Asset) if f.name not in ("clip", "path", "paths"))
_WIDTHS = {"xyz": 3, "velocity": 3, "scale": 3, "rotation": 4, "rgb": 3}


@dataclass(frozen=True)
class LoadedAsset:
    """What a file held. `up`: the axis that points up in it, "Z" in our own files and in what is read from USD, "Y" in
    .spz as Niantic defines it, "-Y" in .ply, .splat and .sog, which say nothing, as in the captures that 3DGS is
    trained on. `motion`: (F,4,4) where the asset is taken at each frame of its clip, in the world, from where the clip
    places it; None where it does not move as a whole."""

    asset: Asset
    up: str
    note: str = ""  # what was left out, for the artist; a sentence or nothing
    motion: np.ndarray | None = None


def static_asset(source: str | Path, xyz, scale, rotation, rgb, opacity) -> Asset:
    """An asset that does not change from arrays of any float dtype, as in Asset; quaternions are normalised. Raises
    InputError (see `check`)."""
    asset = unchecked_static_asset(xyz, scale, rotation, rgb, opacity)
    check(asset, source)
    return asset


def unchecked_static_asset(xyz, scale, rotation, rgb, opacity) -> Asset:
    """The same of numbers that others wrote, for `sound_part`."""
    length = np.linalg.norm(rotation, axis=1, keepdims=True)
    rotation = np.where(length == 0, [1.0, 0, 0, 0], rotation / np.maximum(length, 1e-30))
    n = len(xyz)
    arrays = {"xyz": xyz, "t": np.zeros(n), "velocity": np.zeros((n, 3)), "sigma_t": np.full(n, STATIC_SIGMA_T)}
    arrays |= {"scale": scale, "rotation": rotation, "rgb": rgb, "opacity": opacity}
    with np.errstate(over="ignore", invalid="ignore"):
        exact: dict[str, Any] = {k: np.ascontiguousarray(a, np.float32) for k, a in arrays.items()}
    return Asset(**exact, clip=Clip())


def near_origin(xyz: np.ndarray) -> tuple[np.ndarray, tuple[float, float, float]]:
    """Positions (N,3) float64 and where they are counted from: their middle where that is FAR away, as in the
    coordinates of maps, which float32 would round; else the origin."""
    finite = xyz[np.isfinite(xyz).all(1)]
    if not len(finite):
        return xyz, (0.0, 0.0, 0.0)
    low, middle, high = np.percentile(finite, (5, 50, 95), axis=0)
    if np.abs(middle).max() <= FAR * max((high - low).max(), 1):
        return xyz, (0.0, 0.0, 0.0)
    x, y, z = np.round(middle).tolist()
    return xyz - (x, y, z), (x, y, z)


_WORDS = {"xyz": "position", "t": "time", "sigma_t": "lifetime", "rgb": "colour"}


def sound_part(asset: Asset, source: str | Path) -> tuple[Asset, str]:
    """Of an unchecked asset of others the Gaussians whose numbers are finite, with opacities clamped to 0..1; and a
    sentence on what was left out or clamped, or nothing. Raises InputError: none is left; and see `check`."""
    n, notes = len(asset), []
    if n == 0 or any(len(getattr(asset, k)) != n for k in ARRAYS):
        check(asset, source)
    bad = {k: ~_in_bounds(asset, k) for k in ARRAYS}
    named = " and ".join(_WORDS.get(k, k) for k, rows in bad.items() if rows.any())
    lost = np.logical_or.reduce(list(bad.values()))
    if n and lost.all():
        raise InputError(f"{source}: {named} of all its {n} Gaussians holds NaN or infinity; export it again.")
    if lost.any():
        asset = asset[~lost]
        notes.append(f"{lost.sum()} of {n} Gaussians are left out: NaN, or beyond all bounds, in {named}.")
    if beyond := int(((asset.opacity < -0.01) | (asset.opacity > 1.01)).sum()):
        notes.append(f"The opacities of {beyond} Gaussians are clamped to 0..1.")
    asset = replace(asset, opacity=np.clip(asset.opacity, 0, 1))
    check(asset, source)
    return asset, " ".join(notes)


def _in_bounds(asset: Asset, name: str) -> np.ndarray:
    """(N,) bool: where an array holds no NaN, no infinity, and no colour beyond BRIGHTEST."""
    with np.errstate(invalid="ignore"):
        found = np.abs(getattr(asset, name)) <= (BRIGHTEST if name == "rgb" else np.finfo(np.float32).max)
    return found.reshape(len(asset), -1).all(1)


def check(asset: Asset, source: str | Path = "the asset") -> None:
    """Raises InputError with one sentence that begins with `source` and names the array which has a wrong
    shape or dtype, holds NaN or infinity, or is out of its range; or the clip value that is impossible."""

    def bad(what: str, todo: str = "reconstruct or export it again") -> InputError:
        return InputError(f"{source}: {what}; {todo}.")

    n = len(asset.xyz)
    if n == 0:
        raise bad("it holds no Gaussians")
    for name in ARRAYS:
        a = getattr(asset, name)
        shape = (n, _WIDTHS[name]) if name in _WIDTHS else (n,)
        if not isinstance(a, np.ndarray) or a.dtype != np.float32 or a.shape != shape:
            raise bad(f"{name} is not a float32 array of shape {shape}")
        finite = np.isfinite(a).reshape(n, -1).all(1)
        if not finite.all():
            raise bad(f"{name} holds NaN or infinity ({(~finite).sum()} of {n} Gaussians)")
    if not (bright := _in_bounds(asset, "rgb")).all():
        raise bad(f"rgb holds colours beyond all bounds ({(~bright).sum()} of {n} Gaussians)")
    for name in ("sigma_t", "scale"):
        if not (getattr(asset, name) > 0).all():
            raise bad(f"{name} holds values that are not positive")
    if asset.opacity.min() < 0 or asset.opacity.max() > 1:
        raise bad("opacity leaves the range 0..1")
    if np.abs(np.linalg.norm(asset.rotation.astype(np.float64), axis=1) - 1).max() > 1e-3:
        raise bad("rotation holds quaternions that are not of unit length")
    if asset.paths is not None:
        _check_paths(asset.paths, asset.path, n, bad)
    c = asset.clip
    with np.errstate(over="ignore"):  # in single precision, as Blender has them
        numbers = np.array([c.fps, c.scale, c.pixel, *c.translation], np.float32)
    if not (np.isfinite(numbers).all() and (numbers[:2] > 0).all() and c.pixel >= 0):
        raise bad("fps and scale must be positive, pixel not negative, and these and translation finite")
    if len(c.translation) != 3 or c.frame_end < c.frame_start:
        raise bad("the clip's frame range is empty or its translation is not three numbers")
    if c.frame_end - c.frame_start >= MAX_CLIP_FRAMES or max(abs(c.frame_start), abs(c.frame_end)) > MAX_FRAME_NUMBER:
        raise bad(f"the clip's frames run from {c.frame_start} to {c.frame_end}, which is too many or too far")


def _check_paths(p: Paths, path: np.ndarray | None, n: int, bad: Callable[[str], InputError]) -> None:
    knots = int(p.count.sum()) if p.count.dtype == np.int32 and p.count.ndim == 1 else -1
    shapes = {"start": (len(p),), "end": (len(p),), "place": (knots, 3), "rotation": (knots, 4)}
    for name, shape in shapes.items():
        a = getattr(p, name)
        if a.dtype != np.float32 or a.shape != shape or not np.isfinite(a).all():
            raise bad(f"its paths' {name} is not a float32 array of shape {shape} without NaN and infinity")
    if len(p) > MAX_GAUSSIANS:  # a .ply has their numbers as floats
        raise bad(f"it has more than {MAX_GAUSSIANS:,} paths")
    if not ((p.count >= 1).all() and (p.start < p.end).all()):
        raise bad("it has paths without knots, or that end before they start")
    if np.abs(p.place).max() > FARTHEST_KNOT:
        raise bad("its paths lead beyond all bounds")
    if np.abs(np.linalg.norm(p.rotation.astype(np.float64), axis=1) - 1).max() > 1e-3:
        raise bad("its paths hold quaternions that are not of unit length")
    if path is None or path.shape != (n,) or path.min() < 0 or path.max() >= len(p):
        raise bad("it has Gaussians on paths that are not there")


def rotation_matrices(q: np.ndarray) -> np.ndarray:
    """q (N,4) unit quaternions w x y z -> (N,3,3) rotation matrices."""
    w, x, y, z = q.T
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return np.stack(rows, -1).reshape(-1, 3, 3)


def wxyz_from_xyzw(q: np.ndarray) -> np.ndarray:
    """Quaternions (N,4) in the order of other programs -> in ours."""
    return q[:, [3, 0, 1, 2]]


def xyzw_from_wxyz(q: np.ndarray) -> np.ndarray:
    """Quaternions (N,4) in our order -> in that of other programs."""
    return q[:, [1, 2, 3, 0]]


def linear_from_srgb(rgb: np.ndarray) -> np.ndarray:
    """sRGB-encoded values (any shape) -> linear light, clamped to 0..1."""
    x = np.clip(rgb, 0, 1)
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4).astype(np.float32)


def srgb_from_linear(rgb: np.ndarray) -> np.ndarray:
    """The way back of `linear_from_srgb`."""
    x = np.clip(rgb, 0, 1)
    return np.where(x <= 0.0031308, x * 12.92, 1.055 * x ** (1 / 2.4) - 0.055).astype(np.float32)
