# SPDX-License-Identifier: GPL-3.0-or-later
"""Readers of other programs' Gaussian splats, one for each kind of file; `files.read_asset` chooses among them.
numpy and the standard library only, for inside Blender.

3DGS .ply (see ply.py), SuperSplat's compressed .ply, .splat (antimatter15), .spz (Niantic, versions 1 to 4). Colour
that depends on the direction (spherical harmonics beyond degree 0) is left out. Nothing of a file is believed before
it is checked; what is wrong with it is one InputError. The other way, one moment of a 4D asset for other programs:
slices.py.

Sources: github.com/nianticlabs/spz (README.md, load-spz.cc), github.com/antimatter15/splat (convert.py),
github.com/playcanvas/splat-transform (compressed-chunk.ts).
"""

from __future__ import annotations

import gzip
import io
import re
import struct
import zlib
from collections.abc import Callable
from itertools import accumulate
from pathlib import Path

import numpy as np

from ...datagen.sequence import InputError
from .asset import (
    MAX_GAUSSIANS,
    SH_C0,
    SMALLEST_SCALE,
    Asset,
    LoadedAsset,
    sound_part,
    unchecked_static_asset,
    wxyz_from_xyzw,
)
from .ply import sound_asset_from_bytes
from .ply_tables import MAX_HEADER_BYTES, PlyTables

SCALE_BOUNDS = ("scale_x", "scale_y", "scale_z")  # of a compressed .ply's chunks
PLAUSIBLE = 0.9  # share of a .splat's Gaussians that must be; it says nothing else of what it is
SPLAT_RECORD = np.dtype(
    [("xyz", "<f4", 3), ("scale", "<f4", 3), ("rgb", "u1", 3), ("opacity", "u1"), ("rotation", "u1", 4)]
)
_FILE_SIGNATURES = {  # how files begin that may turn up under one of our suffixes
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


def _wrong_file(path: Path, head: bytes, otherwise: str) -> InputError:
    what = next((kind for magic, kind in _FILE_SIGNATURES.items() if head.startswith(magic)), None)
    if what is None:
        return InputError(f"{path}: {otherwise}; choose a Gaussian splat {path.suffix}.")
    return InputError(f"{path}: it is {what}, not a Gaussian splat {path.suffix}; choose another file.")


def _note(harmonics: bool) -> str:
    return "Its colours that depend on the direction (spherical harmonics) are left out." if harmonics else ""


def _with_largest(largest: np.ndarray, others: np.ndarray) -> np.ndarray:
    """(N,4) unit quaternions from the place of the largest component (N,), which is positive and left out,
    and the three others (N,3) in their order."""
    q = np.empty((len(largest), 4), np.float32)
    for i in range(4):
        at = largest == i
        q[np.ix_(at, [k for k in range(4) if k != i])] = others[at]
        q[at, i] = np.sqrt(np.maximum(0, 1 - (others[at] ** 2).sum(1)))
    return q


# ---------------------------------------------------------------- .ply


def read_any_ply(path: Path) -> LoadedAsset:
    """Our own .ply, other programs' 3DGS .ply, and SuperSplat's compressed one."""
    data = path.read_bytes()
    head, found, _ = data[:MAX_HEADER_BYTES].partition(b"end_header")
    if not head.startswith(b"ply"):
        raise _wrong_file(path, head, "it is not a .ply file")
    if found and b" packed_position" in head:
        return _loaded(path, _read_compressed(data, path), "-Y", _note(b"element sh " in head))
    if found and b" f_dc_0" not in head and b" scale_0" not in head:
        what = "a polygon mesh" if b"element face" in head else "a plain point cloud"
        raise InputError(
            f"{path}: it is {what}, not Gaussians (f_dc_0 is missing); import it with File > Import > Stanford PLY."
        )
    asset, left_out = sound_asset_from_bytes(data, path)
    ours = b"comment timesplat " in head or b" scale_t" in head
    said = re.search(rb"(?i)comment vertical axis: *([yz])\b", head)  # by nerfstudio
    up = "Z" if ours else said[1].decode().upper() if said else "-Y"
    return LoadedAsset(asset, up, " ".join(filter(None, (left_out, _note(b" f_rest_0" in head)))))


def _loaded(path: Path, asset: Asset, up: str, note: str = "") -> LoadedAsset:
    asset, left_out = sound_part(asset, path)
    return LoadedAsset(asset, up, " ".join(filter(None, (left_out, note))))


def _read_compressed(data: bytes, path: Path) -> Asset:
    """Chunks of 256 Gaussians, quantised between the chunk's bounds; unchecked."""
    try:
        tables = PlyTables(data, path)
        chunk, rows = tables.table("chunk"), tables.table("vertex")
        if len(chunk) != -(-len(rows) // 256):
            raise ValueError(f"{len(chunk)} chunks do not belong to {len(rows)} Gaussians")

        def between(names: tuple[str, ...], shares: np.ndarray) -> np.ndarray:
            """(N,k) values from shares 0..1 of the way between the bounds of each one's chunk."""
            low, high = (np.stack([chunk[f"{m}_{n}"] for n in names], 1) for m in ("min", "max"))
            return np.repeat(low, 256, 0)[: len(rows)] * (1 - shares) + np.repeat(high, 256, 0)[: len(rows)] * shares

        def unpacked(name: str, *widths: int) -> list[np.ndarray]:
            """Shares 0..1, (N,) each: the unsigned numbers of these widths that fill 32 bits from the top."""
            shifts, masks = 32 - np.cumsum(widths), [(1 << width) - 1 for width in widths]
            return [((rows[name] >> np.uint32(s)) & np.uint32(m)) / m for s, m in zip(shifts, masks, strict=True)]

        *colours, opacity = unpacked("packed_color", 8, 8, 8, 8)
        rgb = np.stack(colours, 1)
        if "min_r" in chunk.dtype.names:
            rgb = between(("r", "g", "b"), rgb)
        largest, *others = unpacked("packed_rotation", 2, 10, 10, 10)
        with np.errstate(over="ignore", invalid="ignore"):
            return unchecked_static_asset(
                xyz=between(("x", "y", "z"), np.stack(unpacked("packed_position", 11, 10, 11), 1)),
                scale=np.exp(between(SCALE_BOUNDS, np.stack(unpacked("packed_scale", 11, 10, 11), 1))),
                rotation=_with_largest(np.round(largest * 3), (np.stack(others, 1) - 0.5) * np.sqrt(2)),
                rgb=rgb,
                opacity=opacity,
            )
    except InputError:
        raise
    except (ValueError, KeyError, IndexError, TypeError, OverflowError) as e:
        raise InputError(f"{path}: the compressed .ply is truncated or damaged ({e}); export it again.") from None


# ---------------------------------------------------------------- .splat


def plausible(rows: np.ndarray) -> np.ndarray:
    """(N,) of SPLAT_RECORD -> (N,) bool: whether these could be the place and the scale of a Gaussian."""
    with np.errstate(invalid="ignore"):
        return (np.abs(rows["xyz"]) < 1e9).all(1) & (rows["scale"] >= 0).all(1) & (rows["scale"] < 1e9).all(1)


def read_splat(path: Path) -> LoadedAsset:
    """32 bytes a Gaussian and nothing else, so that only implausible values tell another kind of file."""
    data = path.read_bytes()
    if not data:
        raise InputError(f"{path}: it is empty; choose a Gaussian splat .splat.")
    if len(data) % SPLAT_RECORD.itemsize:
        raise _wrong_file(path, data, f"it is truncated or not a .splat ({len(data)} bytes are not a multiple of 32)")
    rows = np.frombuffer(data, SPLAT_RECORD)
    xyz, scale = rows["xyz"], rows["scale"]
    rotation = rows["rotation"].astype(np.float32) / 128 - 1
    unit = np.abs(np.linalg.norm(rotation, axis=1) - 1) < 0.1
    sane = plausible(rows)
    if min(sane.mean(), unit.mean()) < PLAUSIBLE:
        wrong = (~(sane & unit)).sum()
        raise _wrong_file(path, data, f"it is damaged or not a .splat ({wrong} of {len(rows)} Gaussians make no sense)")
    rgb, opacity = (rows[name].astype(np.float32) / 255 for name in ("rgb", "opacity"))
    xyz = np.where(sane[:, None], xyz, np.nan)
    return _loaded(path, unchecked_static_asset(xyz, np.maximum(scale, SMALLEST_SCALE), rotation, rgb, opacity), "-Y")


# ---------------------------------------------------------------- .spz


def read_spz(path: Path) -> LoadedAsset:
    """Versions 1 to 3 are one gzip stream, version 4 has a zstd stream for each property. Only what is needed
    is unpacked, and never more than the header's count asks for."""
    try:
        with open(path, "rb") as f:
            magic = f.read(4)
            f.seek(0)
            if magic == b"NGSP":
                return _spz(path, *_zstd_sections(path, f))
            if magic[:2] != b"\x1f\x8b":
                raise _wrong_file(path, magic + f.read(16)[4:], "it is not an .spz file")
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


def _spz(path: Path, head: bytes, section: Callable[[int, int], bytes]) -> LoadedAsset:
    """head: from its magic number on; section: from a property's size and number to its bytes."""
    version, n, degree, fraction = struct.unpack_from("<IIBB", head, 4)
    if not 1 <= version <= 4:
        raise InputError(f"{path}: it is .spz version {version}, known are 1 to 4; export it as version 3.")
    if not 0 < n <= MAX_GAUSSIANS or fraction > 30:
        raise InputError(
            f"{path}: it claims {n:,} Gaussians; 1 to {MAX_GAUSSIANS:,} can be read, and it may be damaged."
        )
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
    asset = unchecked_static_asset(
        xyz=xyz.view("<f2").astype(np.float32) if version == 1 else np.ldexp(_signed_24_bits(xyz), -fraction),
        scale=np.exp(scale.astype(np.float32) / 16 - 10),
        rotation=wxyz_from_xyzw(_spz_rotation(turn, version)),
        rgb=0.5 + SH_C0 / 0.15 * (colour.astype(np.float32) / 255 - 0.5),
        opacity=alpha.squeeze(1).astype(np.float32) / 255,
    )
    return _loaded(path, asset, "Y", _note(degree > 0))


def _signed_24_bits(data: np.ndarray) -> np.ndarray:
    """(N,9) bytes -> (N,3) numbers as float32."""
    whole = (data.reshape(-1, 3, 3).astype(np.int32) << np.array([0, 8, 16], np.int32)).sum(-1, dtype=np.int32)
    return ((whole ^ 0x800000) - 0x800000).astype(np.float32)


def _spz_rotation(data: np.ndarray, version: int) -> np.ndarray:
    """(N,4) bytes, or (N,3) before version 3 -> (N,4) quaternions x y z w."""
    if version < 3:
        imaginary = data.astype(np.float32) / 127.5 - 1
        real = np.sqrt(np.maximum(0, 1 - (imaginary**2).sum(1, keepdims=True)))
        return np.concatenate([imaginary, real], 1)
    word = data.view("<u4").squeeze(1)
    others = (word[:, None] >> np.array([20, 10, 0], np.uint32)) & 0x3FF  # sign, nine bits
    others = np.where(others >> 9, -1, 1) * (others & 0x1FF) * np.float32(np.sqrt(0.5) / 511)
    return _with_largest(word >> 30, others)
