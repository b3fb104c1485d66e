# SPDX-License-Identifier: GPL-3.0-or-later
"""Reads other programs' Gaussian splats: numpy and the standard library only, for inside Blender.

3DGS .ply (by `asset.read_ply`), SuperSplat's compressed .ply, .splat (antimatter15), .spz (Niantic, versions 1
to 4), and any of these a frame as a sequence. Colour that depends on the direction (spherical harmonics beyond
degree 0) is left out. Nothing of a file is believed before it is checked; what is wrong with it is one
InputError. The other way, one moment of a 4D asset for other programs: slices.py.

Sources: github.com/nianticlabs/spz (README.md, load-spz.cc), github.com/antimatter15/splat (convert.py),
github.com/playcanvas/splat-transform (compressed-chunk.ts).
"""

from __future__ import annotations

import gzip
import io
import re
import struct
import zlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from itertools import accumulate
from pathlib import Path

import numpy as np

from ...datagen.sequence import InputError
from .asset import SH_C0, STATIC_SIGMA_T, Asset, Clip, check, read_ply

SUFFIXES = (".ply", ".splat", ".spz")
MOST = 10_000_000  # Gaussians that a compressed file or a sequence may hold, as in Niantic's reader
SHARE = 1 / 3  # σ_t of a sequence's Gaussians in frames: 1.1 % of their opacity is left a frame away
_MAX_HEADER = 1 << 16
_KINDS = {  # how files begin that may turn up under one of our suffixes
    b"ply": "a .ply file",
    b"\x1f\x8b": "a gzip file, as .spz files are",
    b"NGSP": "an .spz file",
    b"\x89PNG": "a PNG picture",
    b"\xff\xd8\xff": "a JPEG picture",
    b"GIF8": "a GIF picture",
    b"RIFF": "a WebP picture, a sound or a film",
    b"v/1\x01": "an OpenEXR picture",
    b"PXR-USDC": "a USD file",
    b"#usda": "a USD file",
    b"PK\x03\x04": "a zip archive (.usdz, .sog or the like)",
    b"glTF": "a .glb file",
    b"BLENDER": "a .blend file",
    b"(\xb5/\xfd": "a zstd file, as .blend files are",
    b"Kaydara FBX": "an .fbx file",
    b"%PDF": "a PDF document",
    b"<": "a web page or other XML",
    b"{": "a JSON file",
}


@dataclass(frozen=True)
class Loaded:
    """What a file held. `up`: the axis that points up in it, "Z" in our own files, "Y" in .spz as Niantic
    defines it, "-Y" in .ply and .splat, which say nothing, as in the captures that 3DGS is trained on."""

    asset: Asset
    up: str
    note: str = ""  # what was left out, for the artist; a sentence or nothing


# ---------------------------------------------------------------- reading


def read(path: str | Path) -> Loaded:
    """Reads one file by its suffix. Raises InputError: one sentence that names the file and says what it is
    and what was expected."""
    path = Path(path)
    reader = {".ply": _read_any_ply, ".splat": _read_splat, ".spz": _read_spz}.get(path.suffix.lower())
    if reader is None:
        raise InputError(f"{path}: its name must end in {', '.join(SUFFIXES)}; choose one of these.")
    if path.is_dir():
        raise InputError(f"{path}: it is a folder; choose a {path.suffix} file.")
    try:
        return reader(path)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; check the name.") from None
    except OSError as e:
        raise InputError(f"{path}: it cannot be read ({e.strerror or e}); check the file.") from None
    except MemoryError:
        raise InputError(f"{path}: it takes more memory than there is; close other programs or reduce it.") from None


def read_sequence(paths: Iterable[str | Path], *, fps: float = 24.0, frame_start: int = 1) -> Loaded:
    """One asset from a file a frame, in the natural order of the names (2 before 10): file k is frame
    frame_start + k. One file alone is what `read` gives.

    The Gaussians of a file stand still and have σ_t = SHARE frames: at their own frame they have their whole
    opacity, at the neighbouring ones exp(-4.5) = 1.1 % of it, which is below VISIBLE, and half-way between
    two frames 32 %, so that both files are seen faintly. Raises InputError, also where files are 4D already
    or differ in their up axis."""
    paths = sorted(map(Path, paths), key=_natural)
    if not paths:
        raise InputError("No file was chosen; choose the .ply files of a sequence.")
    if len(paths) == 1:
        return read(paths[0])
    clip = Clip(fps, frame_start, frame_start + len(paths) - 1)
    sigma_t = np.float32(SHARE * 2 / (len(paths) - 1))
    parts, ups, notes, total = [], set(), [], 0
    for frame, path in zip(clip.frames, paths, strict=True):
        loaded = read(path)
        asset, n = loaded.asset, len(loaded.asset)
        total += n
        ups.add(loaded.up)
        notes.append(loaded.note)
        if len(ups) > 1 or (asset.sigma_t != STATIC_SIGMA_T).any():
            raise InputError(f"{path}: it is no frame of a sequence (4D already, or of another kind); import it alone.")
        if total > MOST:
            raise InputError(f"{path}: with it the sequence has more than {MOST:,} Gaussians; choose fewer files.")
        own = np.full(n, clip.frame_to_time(frame), np.float32)
        parts.append(replace(asset, t=own, sigma_t=np.full(n, sigma_t)))
    arrays = {k: np.concatenate([getattr(p, k) for p in parts]) for k in vars(parts[0]) if k != "clip"}
    asset = Asset(**arrays, clip=clip)
    check(asset, paths[0].parent)
    return Loaded(asset, ups.pop(), next(filter(None, notes), ""))


def folder_files(folder: str | Path) -> list[Path]:
    """The .ply files right in a folder, in natural order. Raises InputError if there is none."""
    folder = Path(folder)
    try:
        found = [p for p in folder.iterdir() if p.suffix.lower() == ".ply" and not p.name.startswith(".")]
    except OSError as e:
        raise InputError(f"{folder}: it cannot be read ({e.strerror or e}); check the folder.") from None
    if not found:
        raise InputError(f"{folder}: there is no .ply file in this folder; choose one with a .ply a frame.")
    return sorted(found, key=_natural)


def _natural(path: Path) -> list:
    """Sorts numbers in names by their value."""
    return [(int(w), "") if w.isdecimal() else (-1, w.lower()) for w in re.split(r"(\d+)", path.name) if w]


def _wrong_kind(path: Path, head: bytes, otherwise: str) -> InputError:
    what = next((kind for magic, kind in _KINDS.items() if head.startswith(magic)), None)
    if what is None:
        return InputError(f"{path}: {otherwise}; choose a Gaussian splat {path.suffix}.")
    return InputError(f"{path}: it is {what}, not a Gaussian splat {path.suffix}; choose another file.")


def static(source: str | Path, xyz, scale, rotation, rgb, opacity) -> Asset:
    """An asset that does not change from arrays of any float dtype; quaternions are normalised."""
    length = np.linalg.norm(rotation, axis=1, keepdims=True)
    rotation = np.where(length > 0, rotation / np.maximum(length, 1e-30), [1.0, 0, 0, 0])
    n = len(xyz)
    arrays = {"xyz": xyz, "t": np.zeros(n), "velocity": np.zeros((n, 3)), "sigma_t": np.full(n, STATIC_SIGMA_T)}
    arrays |= {"scale": scale, "rotation": rotation, "rgb": rgb, "opacity": opacity}
    asset = Asset(**{k: np.ascontiguousarray(a, np.float32) for k, a in arrays.items()})
    check(asset, source)
    return asset


def _largest(which: np.ndarray, three: np.ndarray) -> np.ndarray:
    """(N,4) unit quaternions from the place of the largest component (N,), which is positive and left out,
    and the three others (N,3) in their order."""
    q = np.empty((len(which), 4), np.float32)
    for i in range(4):
        at = which == i
        q[np.ix_(at, [k for k in range(4) if k != i])] = three[at]
        q[at, i] = np.sqrt(np.maximum(0, 1 - (three[at] ** 2).sum(1)))
    return q


# ---------------------------------------------------------------- .ply


def _read_any_ply(path: Path) -> Loaded:
    with open(path, "rb") as f:
        head, found, _ = f.read(_MAX_HEADER).partition(b"end_header")
    if not head.startswith(b"ply"):
        raise _wrong_kind(path, head, "it is not a .ply file")
    if found and b" packed_position" in head:
        return Loaded(_read_compressed(path), "-Y", _note(b"element sh " in head))
    if found and b" f_dc_0" not in head:
        what = "a polygon mesh" if b"element face" in head else "a plain point cloud"
        raise InputError(
            f"{path}: it is {what}, not Gaussians (f_dc_0 is missing); import it with File > Import > Stanford PLY."
        )
    asset = read_ply(path)
    ours = b"comment timesplat " in head or b" scale_t" in head
    return Loaded(asset, "Z" if ours else "-Y", _note(b" f_rest_0" in head))


def _note(harmonics: bool) -> str:
    return "Its colours that depend on the direction (spherical harmonics) are left out." if harmonics else ""


def _read_compressed(path: Path) -> Asset:
    """SuperSplat's compressed .ply: chunks of 256 Gaussians, quantised between the chunk's bounds."""
    types = {"float": "<f4", "uint": "<u4", "uchar": "u1", "float32": "<f4", "uint32": "<u4", "uint8": "u1"}
    with open(path, "rb") as f:
        data = f.read()
    head, _, _ = data.partition(b"end_header")
    tables, at = {}, data.index(b"\n", len(head)) + 1 if b"\n" in data[len(head) :] else len(data)
    try:
        if b"format binary_little_endian" not in head:
            raise ValueError("it is not binary, little-endian")
        for element in head.decode("ascii", "replace").split("\nelement ")[1:]:
            first, *rows = element.splitlines()
            name, count = first.split()
            if int(count) < 0:
                raise ValueError(f"{count} of {name}")
            words = [r.split() for r in rows if r.startswith("property")]
            dtype = np.dtype([(w[2], types[w[1]]) for w in words])
            tables[name] = np.frombuffer(data, dtype, int(count), at)
            at += int(count) * dtype.itemsize
        chunk, rows = tables["chunk"], tables["vertex"]
        if len(chunk) != -(-len(rows) // 256):
            raise ValueError(f"{len(chunk)} chunks do not belong to {len(rows)} Gaussians")

        def between(names: tuple[str, ...], share: np.ndarray) -> np.ndarray:
            """(N,k) values from shares 0..1 of the way between the bounds of each one's chunk."""
            low, high = (np.stack([chunk[f"{m}_{n}"] for n in names], 1) for m in ("min", "max"))
            return np.repeat(low, 256, 0)[: len(rows)] * (1 - share) + np.repeat(high, 256, 0)[: len(rows)] * share

        def bits(name: str, *widths: int) -> np.ndarray:
            """(N,k) shares 0..1: the unsigned numbers of these widths that fill 32 bits from the top."""
            shifts = 32 - np.cumsum(widths)
            masks = (1 << np.array(widths)) - 1
            return ((rows[name][:, None] >> shifts.astype(np.uint32)) & masks) / masks

        colour = bits("packed_color", 8, 8, 8, 8)
        rgb = between(("r", "g", "b"), colour[:, :3]) if "min_r" in chunk.dtype.names else colour[:, :3]
        turn = bits("packed_rotation", 2, 10, 10, 10)
        with np.errstate(over="ignore", invalid="ignore"):  # what overflows is refused by `check`
            return static(
                path,
                xyz=between(("x", "y", "z"), bits("packed_position", 11, 10, 11)),
                scale=np.exp(between(("scale_x", "scale_y", "scale_z"), bits("packed_scale", 11, 10, 11))),
                rotation=_largest(np.round(turn[:, 0] * 3), (turn[:, 1:] - 0.5) * np.sqrt(2)),
                rgb=rgb,
                opacity=colour[:, 3],
            )
    except InputError:
        raise
    except (ValueError, KeyError, IndexError, TypeError, OverflowError) as e:
        raise InputError(f"{path}: the compressed .ply is truncated or damaged ({e}); export it again.") from None


# ---------------------------------------------------------------- .splat

SPLAT = np.dtype([("xyz", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])


def _read_splat(path: Path) -> Loaded:
    """32 bytes a Gaussian and nothing else, so that only implausible values tell another kind of file."""
    data = path.read_bytes()
    if not data:
        raise InputError(f"{path}: it is empty; choose a Gaussian splat .splat.")
    if len(data) % SPLAT.itemsize:
        raise _wrong_kind(path, data, f"it is truncated or not a .splat ({len(data)} bytes are not a multiple of 32)")
    rows = np.frombuffer(data, SPLAT)
    xyz, scale = rows["xyz"], rows["scale"]
    rotation = rows["rotation"].astype(np.float32) / 128 - 1
    unit = np.abs(np.linalg.norm(rotation, axis=1) - 1) < 0.1
    with np.errstate(invalid="ignore"):
        sane = (np.abs(xyz) < 1e9).all(1) & (scale >= 0).all(1) & (scale < 1e9).all(1)
    if not sane.all() or unit.mean() < 0.9:
        wrong = (~(sane & unit)).sum()
        raise _wrong_kind(path, data, f"it is damaged or not a .splat ({wrong} of {len(rows)} Gaussians make no sense)")
    rgba = rows["rgba"].astype(np.float32) / 255
    asset = static(path, xyz, np.maximum(scale, 1e-9), rotation, rgba[:, :3], rgba[:, 3])
    return Loaded(asset, "-Y")


# ---------------------------------------------------------------- .spz


def _read_spz(path: Path) -> Loaded:
    """Versions 1 to 3 are one gzip stream, version 4 has a zstd stream for each property. Only what is needed
    is unpacked, and never more than the header's count asks for."""
    try:
        with open(path, "rb") as f:
            magic = f.read(4)
            f.seek(0)
            if magic == b"NGSP":
                return _spz(path, *_zstd_sections(path, f))
            if magic[:2] != b"\x1f\x8b":
                raise _wrong_kind(path, magic + f.read(16)[4:], "it is not an .spz file")
            stream = gzip.GzipFile(fileobj=f)
            head = stream.read(16)
            if head[:4] != b"NGSP":
                raise InputError(f"{path}: it is a gzip file, but what is packed is not .spz; choose another file.")
            return _spz(path, head, lambda size, _: stream.read(size))
    except (EOFError, gzip.BadGzipFile, zlib.error, struct.error) as e:
        raise InputError(f"{path}: it is truncated or damaged ({e}); copy or export it again.") from None


def _zstd_sections(path: Path, f) -> tuple[bytes, Callable[[int, int], bytes]]:
    """Of a version 4 file: its header and a function from a section's size and number to its bytes."""
    try:
        from compression import zstd  # Python 3.14

        unpack, errors = zstd.open, (zstd.ZstdError,)
    except ImportError:
        try:
            import zstandard  # Blender brings it

            unpack, errors = zstandard.ZstdDecompressor().stream_reader, (zstandard.ZstdError,)
        except ImportError:
            raise InputError(f"{path}: .spz version 4 needs Python's zstandard; export it as version 3.") from None
    head = f.read(32)
    streams, toc = struct.unpack_from("<BI", head, 15)
    f.seek(toc)
    table = struct.unpack(f"<{2 * streams}Q", f.read(16 * streams))
    starts = list(accumulate([toc + 16 * streams, *table[::2]]))

    def section(size: int, number: int) -> bytes:
        if number >= streams or table[2 * number + 1] != size:
            raise EOFError(f"its stream {number} has not the {size} bytes that belong there")
        f.seek(min(starts[number], 1 << 62))
        packed = f.read(min(table[2 * number], 4 * size + 1024))  # zstd never makes data much larger
        try:
            with unpack(io.BytesIO(packed)) as stream:
                return stream.read(size)
        except errors as e:
            raise EOFError(str(e)) from None

    return head, section


def _spz(path: Path, head: bytes, section: Callable[[int, int], bytes]) -> Loaded:
    version, n, degree, fraction = struct.unpack_from("<IIBB", head, 4)
    if not 1 <= version <= 4:
        raise InputError(f"{path}: it is .spz version {version}, known are 1 to 4; export it as version 3.")
    if not 0 < n <= MOST or fraction > 30:
        raise InputError(f"{path}: it claims {n:,} Gaussians; 1 to {MOST:,} can be read, and it may be damaged.")
    widths = (6 if version == 1 else 9, 1, 3, 3, 4 if version >= 3 else 3)
    if n > 100_000 and sum(widths) * n > 100 * path.stat().st_size:  # splats pack to a third; this is a bomb
        raise EOFError(f"{n} Gaussians were announced, and so few bytes hold no more than repetition")
    parts = []
    for number, width in enumerate(widths):
        data = section(width * n, number)
        if len(data) < width * n:
            raise EOFError(f"{n} Gaussians were announced, and there are fewer")
        parts.append(np.frombuffer(data, np.uint8).reshape(n, width))
    xyz, alpha, colour, scale, turn = parts
    if version == 1:
        xyz = xyz.view("<f2").astype(np.float32)
    else:  # signed numbers of 24 bits
        whole = (xyz.reshape(n, 3, 3).astype(np.int32) << np.array([0, 8, 16], np.int32)).sum(-1, dtype=np.int32)
        xyz = np.ldexp(((whole ^ 0x800000) - 0x800000).astype(np.float32), -fraction)
    if version >= 3:
        word = turn.view("<u4")[:, 0]
        three = (word[:, None] >> np.array([20, 10, 0], np.uint32)) & 0x3FF  # sign, nine bits
        three = np.where(three >> 9, -1, 1) * (three & 0x1FF) * np.float32(np.sqrt(0.5) / 511)
        rotation = _largest(word >> 30, three)
    else:
        three = turn.astype(np.float32) / 127.5 - 1
        rotation = np.concatenate([three, np.sqrt(np.maximum(0, 1 - (three**2).sum(1, keepdims=True)))], 1)
    asset = static(
        path,
        xyz=xyz,
        scale=np.exp(scale.astype(np.float32) / 16 - 10),
        rotation=rotation[:, [3, 0, 1, 2]],  # x y z w in the file
        rgb=0.5 + SH_C0 / 0.15 * (colour.astype(np.float32) / 255 - 0.5),
        opacity=alpha[:, 0].astype(np.float32) / 255,
    )
    return Loaded(asset, "Y", _note(degree > 0))
