# SPDX-License-Identifier: GPL-3.0-or-later
"""A 4D Gaussian asset as arrays, and its .ply file. numpy only, so that it runs inside Blender.

The file is a binary little-endian PLY with the property names of 3D Gaussian Splatting, so that viewers of
those show it (every Gaussian at its own time), followed by t, scale_t, vx, vy, vz. Two things are left out:
normals, which no splat viewer uses, and f_rest_*, because the colour does not depend on the direction.
Clip metadata stands in `comment timesplat <key> <value>` lines. See docs of `write_ply` for the units.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import numpy as np

from ...datagen.sequence import WINDOWS, InputError, Sequence, move

SH_C0 = 0.28209479177387814  # the constant spherical harmonic: rgb = 0.5 + SH_C0 * f_dc
VISIBLE = 0.05  # opacity below which a Gaussian counts as invisible at a moment (the paper's filter)
STATIC_SIGMA_T = 1e4  # lifetime of what does not change: exp(-½(2/1e4)²) is 1 in float32
BLUR = 0.3  # px² that rasterisers of splats add to the covariance on the screen
LONGEST, LAST = 50_000, 1 << 20  # frames: more than half an hour; and as far as Blender counts
OPACITY_EPS = 1e-6  # opacities are kept this far from 0 and 1 in a .ply, where they are logits

VERSION = 1
GAUSSIAN_3D = (
    *("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)
TIME_4D = ("t", "scale_t", "vx", "vy", "vz")
_TYPES = {"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2"}
_TYPES |= {"ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4"}
_TYPES |= {"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"}
_MAX_HEADER = 1 << 16


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
    """N 4D Gaussians in kinematic form (see model/gaussians.py), all arrays float32, linear values."""

    xyz: np.ndarray  # (N,3) position at its own time, normalised space
    t: np.ndarray  # (N,) its own time, clip = [-1,1]
    velocity: np.ndarray  # (N,3) normalised units per unit of t
    sigma_t: np.ndarray  # (N,) > 0
    scale: np.ndarray  # (N,3) standard deviations, > 0
    rotation: np.ndarray  # (N,4) unit quaternion w x y z
    rgb: np.ndarray  # (N,3) sRGB-encoded, 0..1
    opacity: np.ndarray  # (N,) 0..1
    clip: Clip = field(default_factory=Clip)

    def __len__(self) -> int:
        return len(self.xyz)

    def at(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Positions (N,3) in normalised space and opacities (N,) 0..1 at a model time (-1..1 over the clip,
        any fraction; times outside continue the lines)."""
        dt = np.float32(time) - self.t
        with np.errstate(under="ignore", over="ignore"):
            opacity = self.opacity * np.exp(-0.5 * (dt / self.sigma_t) ** 2)
            return self.xyz + self.velocity * dt[:, None], opacity

    def frame_to_time(self, frame):
        """Model time of a (fractional) frame number of the clip: frame_start is -1, frame_end is +1."""
        return self.clip.frame_to_time(frame)

    def soft_scale(self) -> np.ndarray:
        """(N,3) standard deviations as they looked in the pictures that the asset was fitted to, where the
        rasteriser blurred by BLUR px². Renderers which do not, or at a higher resolution, show holes
        between Gaussians with the plain `scale`. Equal to it where clip.pixel is 0."""
        return np.sqrt(self.scale**2 + np.float32(BLUR * self.clip.pixel**2))

    def softened(self) -> Asset:
        """The same with `soft_scale` for good (clip.pixel 0), for viewers that know nothing of pixels."""
        return replace(self, scale=self.soft_scale(), clip=replace(self.clip, pixel=0.0))


ARRAYS = tuple(f.name for f in fields(Asset) if f.name != "clip")
_WIDTHS = {"xyz": 3, "velocity": 3, "scale": 3, "rotation": 4, "rgb": 3}


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
    for name in ("sigma_t", "scale"):
        if not (getattr(asset, name) > 0).all():
            raise bad(f"{name} holds values that are not positive")
    if asset.opacity.min() < 0 or asset.opacity.max() > 1:
        raise bad("opacity leaves the range 0..1")
    if np.abs(np.linalg.norm(asset.rotation.astype(np.float64), axis=1) - 1).max() > 1e-3:
        raise bad("rotation holds quaternions that are not of unit length")
    c = asset.clip
    with np.errstate(over="ignore"):  # in single precision, as Blender has them
        numbers = np.array([c.fps, c.scale, c.pixel, *c.translation], np.float32)
    if not (np.isfinite(numbers).all() and (numbers[:2] > 0).all() and c.pixel >= 0):
        raise bad("fps and scale must be positive, pixel not negative, and these and translation finite")
    if len(c.translation) != 3 or c.frame_end < c.frame_start:
        raise bad("the clip's frame range is empty or its translation is not three numbers")
    if c.frame_end - c.frame_start >= LONGEST or max(abs(c.frame_start), abs(c.frame_end)) > LAST:
        raise bad(f"the clip's frames run from {c.frame_start} to {c.frame_end}, which is too many or too far")


def pixel_size(sequence: Sequence) -> float:
    """Clip.pixel: the median over the views of a pixel's size at the origin, in normalised units."""
    return float(np.median([np.linalg.norm(v.c2w[:3, 3]) / v.fx for v in sequence.views]))


def rotation_matrices(q: np.ndarray) -> np.ndarray:
    """q (N,4) unit quaternions w x y z -> (N,3,3) rotation matrices."""
    w, x, y, z = q.T
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return np.stack(rows, -1).reshape(-1, 3, 3)


def linear_from_srgb(rgb: np.ndarray) -> np.ndarray:
    """sRGB-encoded values (any shape) -> linear light, clamped to 0..1."""
    x = np.clip(rgb, 0, 1)
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4).astype(np.float32)


@contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """Yields a name beside `path` (same suffix) to write to; it is moved to `path` on success, removed on
    any error. The folder is made. An OSError becomes an InputError that names the path."""
    path = Path(path)
    tmp = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield tmp
        move(tmp, path)
    except OSError as e:
        todo = "choose another place"
        if WINDOWS and isinstance(e, PermissionError) and path.is_file():
            todo = f"close the program that has it open, or {todo}"
        raise InputError(f"{path}: it cannot be written ({e.strerror or e}); {todo}.") from None
    finally:
        with suppress(OSError):  # where the folder is a file, say
            tmp.unlink(missing_ok=True)


# ---------------------------------------------------------------- .ply


def write_ply(path: str | Path, asset: Asset) -> None:
    """Writes the asset; the file appears whole or not at all. Raises InputError (see `check`).

    Positions and velocities are in normalised units (per unit of model time), f_dc = (rgb - 0.5)/SH_C0,
    opacity is a logit, scale_* and scale_t are natural logs, rot_* is w x y z. Reading gives the same
    values back to float32 precision (a relative 1e-6), except that opacities nearer than 1e-6 to 0 or 1
    are moved to that distance."""
    check(asset, path)
    o = np.clip(asset.opacity.astype(np.float64), OPACITY_EPS, 1 - OPACITY_EPS)
    columns = [
        asset.xyz,
        (asset.rgb.astype(np.float64) - 0.5) / SH_C0,
        np.log(o / (1 - o))[:, None],
        np.log(asset.scale.astype(np.float64)),
        asset.rotation,
        asset.t[:, None],
        np.log(asset.sigma_t.astype(np.float64))[:, None],
        asset.velocity,
    ]
    table = np.concatenate([c.astype("<f4") for c in columns], 1)
    c = asset.clip
    meta = {"version": VERSION, "fps": repr(float(c.fps)), "frame_start": c.frame_start}
    meta |= {"frame_end": c.frame_end, "scale": repr(float(c.scale))}
    meta |= {"translation": " ".join(repr(float(x)) for x in c.translation), "colour_space": "sRGB"}
    meta |= {"pixel": repr(float(c.pixel))}
    header = ["ply", "format binary_little_endian 1.0"]
    header += [f"comment timesplat {k} {v}" for k, v in meta.items()]
    header += [f"element vertex {len(asset)}", *(f"property float {p}" for p in GAUSSIAN_3D + TIME_4D)]
    with atomic(Path(path)) as tmp, open(tmp, "wb") as f:
        f.write("\n".join([*header, "end_header", ""]).encode("ascii"))
        f.write(table.tobytes())


def read_ply(path: str | Path) -> Asset:
    """Reads what `write_ply` wrote, or any uncompressed binary 3DGS .ply: without the time columns it is a
    static asset (v = 0, t = 0, sigma_t = STATIC_SIGMA_T), without comments the clip is Clip(). Unknown
    properties (normals, f_rest_*) are passed over; quaternions are normalised, zero ones become the
    identity. Raises InputError: one sentence with the file, what is wrong and what to do."""
    path = Path(path)
    try:
        with open(path, "rb") as f:
            head = f.read(_MAX_HEADER)
            names, dtype, count, meta, offset = _header(head, path)
            have = os.fstat(f.fileno()).st_size - offset
            if have < count * dtype.itemsize:
                raise InputError(
                    f"{path}: the file is truncated, {count} Gaussians were announced and there is data for "
                    f"{have // dtype.itemsize}; copy or export it again."
                )
            f.seek(offset)
            rows = np.fromfile(f, dtype, count)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; check the name.") from None
    except OSError as e:
        raise InputError(f"{path}: it cannot be read ({e.strerror or e}); check the file.") from None
    missing = [p for p in GAUSSIAN_3D if p not in names]
    if missing:
        hint = "it is a compressed splat file" if "packed_position" in names else "it is not a Gaussian splat"
        raise InputError(
            f"{path}: the property {missing[0]} is missing, {hint}; export it as an uncompressed 3DGS .ply."
        )
    time = [p for p in TIME_4D if p in names]
    if time and len(time) < len(TIME_4D):
        lost = next(p for p in TIME_4D if p not in names)
        raise InputError(f"{path}: it has {time[0]} but lacks {lost}; export it again from Timesplat.")

    def get(*props: str) -> np.ndarray:
        out = np.stack([rows[p] for p in props], -1).astype(np.float64)
        wrong = ~np.isfinite(out)
        if wrong.any():
            prop = props[int(wrong.any(0).argmax())]
            raise InputError(
                f"{path}: {prop} holds NaN or infinity in {wrong.any(1).sum()} of {count} Gaussians; "
                "remove those Gaussians or export the file again."
            )
        return out

    with np.errstate(over="ignore", invalid="ignore"):  # what overflows is refused by `check`
        quaternion = get("rot_0", "rot_1", "rot_2", "rot_3")
        length = np.linalg.norm(quaternion, axis=1, keepdims=True)
        quaternion = np.where(length > 0, quaternion / np.maximum(length, 1e-300), [1.0, 0, 0, 0])
        arrays = {
            "xyz": get("x", "y", "z"),
            "t": get("t")[:, 0] if time else np.zeros(count),
            "velocity": get("vx", "vy", "vz") if time else np.zeros((count, 3)),
            "sigma_t": np.exp(get("scale_t"))[:, 0] if time else np.full(count, STATIC_SIGMA_T),
            "scale": np.exp(get("scale_0", "scale_1", "scale_2")),
            "rotation": quaternion,
            "rgb": 0.5 + SH_C0 * get("f_dc_0", "f_dc_1", "f_dc_2"),
            "opacity": 1 / (1 + np.exp(-get("opacity")[:, 0])),
        }
        asset = Asset(**{k: a.astype(np.float32) for k, a in arrays.items()}, clip=_clip(meta, path))
    check(asset, path)
    return asset


def _header(head: bytes, path: Path) -> tuple[list[str], np.dtype, int, dict[str, str], int]:
    """-> property names, row dtype, number of rows, `comment timesplat` values, where the data begins."""
    if not re.match(rb"ply\r?\n", head):
        raise InputError(f"{path}: it is not a .ply file; choose a Gaussian splat .ply.")
    end = re.search(rb"\nend_header\r?\n", head)
    if end is None:
        raise InputError(f"{path}: the header has no end, the file is truncated; copy or export it again.")
    order, count, props, meta, elements = None, 0, [], {}, []
    try:
        for line in head[: end.start()].decode("utf-8", "replace").splitlines()[1:]:
            word = line.split()
            if word[:1] == ["format"]:
                order = {"binary_little_endian": "<", "binary_big_endian": ">"}.get(word[1])
                if order is None:
                    raise InputError(f"{path}: its format is {word[1]}; convert it to a binary .ply.")
            elif word[:2] == ["comment", "timesplat"]:
                meta[word[2]] = " ".join(word[3:])
            elif word[:1] == ["element"]:
                elements.append(word[1])
                if word[1] == "vertex":
                    count = int(word[2])
            elif word[:1] == ["property"] and elements[-1] == "vertex":
                if order is None:
                    raise ValueError("it names no format")
                props.append((word[2], order + _TYPES[word[1]]))
        if elements[:1] != ["vertex"]:
            first = elements[0] if elements else "nothing"
            raise InputError(
                f"{path}: its first element is {first}, not vertex; export it as an uncompressed 3DGS .ply."
            )
        if count < 0 or not props:
            raise ValueError("no vertices")
        dtype = np.dtype(props)
    except InputError:
        raise
    except (ValueError, KeyError, IndexError, TypeError) as e:
        raise InputError(f"{path}: the header is damaged ({e}); copy or export it again.") from None
    return [p for p, _ in props], dtype, count, meta, end.end()


def _clip(meta: dict[str, str], path: Path) -> Clip:
    if not meta:
        return Clip()
    try:
        if int(meta["version"]) > VERSION:
            raise InputError(f"{path}: it was written by a newer Timesplat; update yours.")
        x, y, z = (float(v) for v in meta["translation"].split())
        return Clip(
            fps=float(meta["fps"]),
            frame_start=int(meta["frame_start"]),
            frame_end=int(meta["frame_end"]),
            scale=float(meta["scale"]),
            translation=(x, y, z),
            pixel=float(meta.get("pixel", 0)),
        )
    except (KeyError, ValueError) as e:
        if isinstance(e, InputError):
            raise
        raise InputError(f"{path}: the clip's comments are damaged ({e}); export it again.") from None
