# SPDX-License-Identifier: GPL-3.0-or-later
"""The few picture files that rendering reads and writes, with numpy and zlib alone: inside Blender there is
neither Pillow nor the OpenEXR package. What comes from other people is read with those (`sequence`)."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np

_TYPES = {0: np.dtype("<u4"), 1: np.dtype("<f2"), 2: np.dtype("<f4")}  # EXR's pixel types
_MULTIPART = 0x1000


def write_png(path: Path, rgba: np.ndarray) -> None:
    """(H,W,4) uint8, straight alpha, marked as sRGB."""
    Path(path).write_bytes(encode_png(rgba))


def encode_png(rgba: np.ndarray) -> bytes:
    """What `write_png` writes. Each row is stored as the difference to the one above."""
    height, width, _ = rgba.shape
    rows = rgba.reshape(height, width * 4)
    up = rows - np.concatenate([np.zeros_like(rows[:1]), rows[:-1]])  # uint8 wraps, as the filter wants
    filtered = np.concatenate([np.full((height, 1), 2, np.uint8), up], 1)

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 6, 0, 0, 0))
        + chunk(b"sRGB", b"\0")
        + chunk(b"IDAT", zlib.compress(filtered.tobytes(), 6))
        + chunk(b"IEND", b"")
    )


def write_exr(path: Path, channels: dict[str, np.ndarray]) -> None:
    """Single-part scanline EXR with ZIP compression. channels: name -> (H,W) float16 or float32, all alike in
    shape; rows from the top."""
    names = sorted(channels)
    height, width = channels[names[0]].shape
    kinds = {np.dtype(np.float16): 1, np.dtype(np.float32): 2}
    listing = b"".join(n.encode() + b"\0" + struct.pack("<iB3xii", kinds[channels[n].dtype], 0, 1, 1) for n in names)
    box = struct.pack("<4i", 0, 0, width - 1, height - 1)
    attributes = (
        ("channels", "chlist", listing + b"\0"),
        ("compression", "compression", b"\x03"),
        ("dataWindow", "box2i", box),
        ("displayWindow", "box2i", box),
        ("lineOrder", "lineOrder", b"\0"),
        ("pixelAspectRatio", "float", struct.pack("<f", 1)),
        ("screenWindowCenter", "v2f", struct.pack("<2f", 0, 0)),
        ("screenWindowWidth", "float", struct.pack("<f", 1)),
    )
    head = struct.pack("<II", 20000630, 2)
    for name, kind, value in attributes:
        head += name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value
    head += b"\0"

    rows = [  # per scanline: the channels one after the other
        b"".join(channels[n][y].astype(channels[n].dtype.newbyteorder("<")).tobytes() for n in names)
        for y in range(height)
    ]
    chunks = []
    for y in range(0, height, 16):
        raw = np.frombuffer(b"".join(rows[y : y + 16]), np.uint8)
        split = np.concatenate([raw[0::2], raw[1::2]])  # low bytes, then high bytes; then differences
        delta = split.copy()
        delta[1:] = split[1:] - split[:-1] + np.uint8(128)
        packed = zlib.compress(delta.tobytes(), 4)
        data = packed if len(packed) < len(raw) else raw.tobytes()
        chunks.append(struct.pack("<ii", y, len(data)) + data)
    offsets = np.cumsum([len(head) + 8 * len(chunks)] + [len(c) for c in chunks[:-1]]).astype("<u8")
    Path(path).write_bytes(head + offsets.tobytes() + b"".join(chunks))


def read_exr(path: Path) -> dict[str, np.ndarray]:
    """All channels of an uncompressed scanline EXR with one or more parts, as Blender writes them: channel
    name -> (H,W) float16/float32, rows from the top. Raises ValueError for any other kind of EXR."""
    data = Path(path).read_bytes()
    magic, version = struct.unpack_from("<II", data)
    multipart = bool(version & _MULTIPART)
    if magic != 20000630 or version & 0x200:
        raise ValueError(f"{path}: not a scanline EXR")
    at, headers = 8, []
    while True:
        header, at = _header(data, at)
        if header:
            headers.append(header)
        if not multipart or not header:
            break
    parts = []
    for header in headers:
        x0, y0, x1, y1 = struct.unpack("<4i", header["dataWindow"])
        if header["compression"] != b"\0":
            raise ValueError(f"{path}: a compressed EXR")
        at += 8 * (y1 - y0 + 1)  # the table of offsets: the chunks are read in the order of the file
        pixels = {n: np.empty((y1 - y0 + 1, x1 - x0 + 1), t) for n, t in _channels(header["channels"])}
        parts.append((y0, pixels))
    for _ in range(sum(len(next(iter(pixels.values()))) for _, pixels in parts)):
        part = struct.unpack_from("<i", data, at)[0] if multipart else 0
        at += 4 * multipart
        y, size = struct.unpack_from("<ii", data, at)
        at += 8
        y0, pixels = parts[part]
        offset = at
        for image in pixels.values():
            image[y - y0] = np.frombuffer(data, image.dtype, image.shape[1], offset)
            offset += image[0].nbytes
        at += size
    return {name: image for _, pixels in parts for name, image in pixels.items()}


def _string(data: bytes, at: int) -> tuple[str, int]:
    end = data.index(b"\0", at)
    return data[at:end].decode(), end + 1


def _header(data: bytes, at: int) -> tuple[dict[str, bytes], int]:
    header = {}
    while True:
        name, at = _string(data, at)
        if not name:
            return header, at
        _kind, at = _string(data, at)
        (size,) = struct.unpack_from("<i", data, at)
        header[name] = data[at + 4 : at + 4 + size]
        at += 4 + size


def _channels(listing: bytes) -> list[tuple[str, np.dtype]]:
    at, out = 0, []
    while listing[at]:
        name, at = _string(listing, at)
        out.append((name, _TYPES[struct.unpack_from("<i", listing, at)[0]]))
        at += 16
    return out
