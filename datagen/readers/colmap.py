# SPDX-License-Identifier: GPL-3.0-or-later
"""COLMAP's models, text and binary: `cameras`, `images` and `points3D` in `sparse/0`, `sparse` or the folder itself,
the pictures in `images/`, masks, if any, in `masks/`. Cameras are world-to-camera with OpenCV axes; pixel centres at
+0.5 as ours. Moments come of the pictures' paths, see `times.of_names`. A parser of our own: three tables of numbers
are not worth a compiled dependency."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..sequence import InputError, read_from
from .lenses import Lens
from .posed import REMEDY, Posed, PosedScene

PLACES = ("sparse/0", "sparse", "colmap/sparse/0", "")  # of the tables, in this order
# Number and name of each model that is read, and its parameters; others have more of them than can be said so.
MODELS = {
    0: ("SIMPLE_PINHOLE", "f cx cy"),
    1: ("PINHOLE", "fx fy cx cy"),
    2: ("SIMPLE_RADIAL", "f cx cy k1"),
    3: ("RADIAL", "f cx cy k1 k2"),
    4: ("OPENCV", "fx fy cx cy k1 k2 p1 p2"),
    5: ("OPENCV_FISHEYE", "fx fy cx cy k1 k2 k3 k4"),
    6: ("FULL_OPENCV", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    8: ("SIMPLE_RADIAL_FISHEYE", "f cx cy k1"),
    9: ("RADIAL_FISHEYE", "f cx cy k1 k2"),
}
OTHERS = {7: "FOV", 10: "THIN_PRISM_FISHEYE", 11: "RAD_TAN_THIN_PRISM_FISHEYE"}
NUMBERS = {name: number for number, (name, _) in MODELS.items()}


def model_folder(folder: Path) -> Path | None:
    """Where below a folder a COLMAP model is, if there is one."""
    for place in PLACES:
        for suffix in (".bin", ".txt"):
            if all((folder / place / f"{name}{suffix}").is_file() for name in ("cameras", "images")):
                return folder / place
    return None


def read_colmap(folder: Path) -> PosedScene:
    """What the model in a folder says. Raises InputError naming the file and the fault."""
    model = model_folder(folder)
    if model is None:
        raise InputError(f"{folder / 'sparse/0/cameras.bin'}: no such file, nor cameras.txt; give a COLMAP project.")
    suffix = ".bin" if (model / "cameras.bin").is_file() and (model / "images.bin").is_file() else ".txt"
    path = model / f"images{suffix}"
    binary = suffix == ".bin"
    with _read(model / f"cameras{suffix}"):
        lenses = dict(_cameras_bin(model) if binary else _cameras_txt(model))
    with _read(path):
        images = sorted(_images_bin(path) if binary else _images_txt(path), key=lambda x: x[0])
    scene = PosedScene(folder, path, "COLMAP", [], axes="w2c-opencv", upright=False)
    home = "images/" if (folder / "images").is_dir() else ""
    for name, w2c, camera in images:
        if camera not in lenses:
            raise InputError(f"{path}: {name} has the camera {camera}, which cameras{suffix} lacks; {REMEDY}.")
        masks = (f"masks/{name}.png", f"masks/{Path(name).with_suffix('.png').as_posix()}")
        mask = next((m for m in masks if (folder / m).is_file()), None)
        scene.pictures.append(Posed(f"{home}{name}", w2c, lenses[camera], mask=mask))
    scene.points = read_points(model)
    return scene


def read_points(model: Path) -> np.ndarray | None:
    """(P,3) of points3D, where there is such a table. Raises InputError."""
    for suffix, read in ((".bin", _points_bin), (".txt", _points_txt)):
        path = model / f"points3D{suffix}"
        if path.is_file():
            with _read(path):
                return read(path)
    return None


def _read(path: Path):
    return read_from(path, REMEDY)


def lens_of(model: str | int, width: int, height: int, values: list[float]) -> Lens:
    """A camera's lens. Raises ValueError for a model that is not read."""
    number = NUMBERS.get(model, -1) if isinstance(model, str) else model
    if number not in MODELS:
        name = OTHERS.get(number, model) if isinstance(model, int) else model
        raise InputError(f"{name} is no lens model that is read; run COLMAP's image_undistorter on the pictures first.")
    name, words = MODELS[number]
    p = dict(zip(words.split(), map(float, values), strict=True))
    fisheye = name.endswith("FISHEYE")
    full = name == "FULL_OPENCV"
    return Lens(
        width, height, p.get("fx", p.get("f", 0)), p.get("fy", p.get("f", 0)), p["cx"], p["cy"],
        radial=tuple(p[k] for k in ("k1", "k2", "k3", *(() if full else ("k4",))) if k in p),
        divisor=tuple(p[k] for k in ("k4", "k5", "k6")) if full else (),
        tangential=(p.get("p1", 0.0), p.get("p2", 0.0)),
        fisheye=fisheye,
    )  # fmt: skip


def pose_of(quaternion: list[float], translation: list[float]) -> np.ndarray:
    """(4,4) world-to-camera of a quaternion w x y z and a translation."""
    w, x, y, z = np.array(quaternion, float) / np.linalg.norm(quaternion)
    m = np.eye(4)
    m[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    m[:3, 3] = translation
    return m


# ---------------------------------------------------------------- text


def _lines(path: Path) -> Iterator[str]:
    for line in path.read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            yield line


def _cameras_txt(model: Path) -> Iterator[tuple[int, Lens]]:
    for line in filter(str.strip, _lines(model / "cameras.txt")):
        number, name, width, height, *values = line.split()
        yield int(number), _named(model / "cameras.txt", name, int(width), int(height), [float(v) for v in values])


def _images_txt(path: Path) -> Iterator[tuple[str, np.ndarray, int]]:
    lines = list(_lines(path))
    while lines and not lines[0].strip():
        lines.pop(0)
    for line in lines[::2]:  # the second of two lists an image's points, and may be empty
        if not line.strip():
            continue
        words = line.split(maxsplit=9)
        if len(words) < 10:
            raise ValueError(f"a line of {len(words)} words in place of an image's 10")
        numbers = [float(w) for w in words[1:8]]
        yield words[9].strip(), pose_of(numbers[:4], numbers[4:]), int(words[8])


def _points_txt(path: Path) -> np.ndarray:
    rows = [[float(w) for w in line.split()[1:4]] for line in filter(str.strip, _lines(path))]
    return np.array(rows, float).reshape(-1, 3)


# ---------------------------------------------------------------- binary


class _Bytes:
    """Numbers out of a file, one after the other. Raises ValueError where it ends too early."""

    def __init__(self, path: Path):
        self.data, self.at = path.read_bytes(), 0

    def take(self, form: str) -> tuple:
        size = struct.calcsize("<" + form)
        if self.at + size > len(self.data):
            raise ValueError("it ends too early")
        out = struct.unpack_from("<" + form, self.data, self.at)
        self.at += size
        return out

    def name(self) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise ValueError("it ends too early")
        text = self.data[self.at : end].decode("utf-8")
        self.at = end + 1
        return text

    def skip(self, size: int) -> None:
        if self.at + size > len(self.data):
            raise ValueError("it ends too early")
        self.at += size


def _cameras_bin(model: Path) -> Iterator[tuple[int, Lens]]:
    data = _Bytes(model / "cameras.bin")
    (count,) = data.take("Q")
    for _ in range(count):
        number, kind, width, height = data.take("iiQQ")
        words = MODELS[kind][1].split() if kind in MODELS else []
        values = list(data.take(f"{len(words)}d"))
        yield number, _named(model / "cameras.bin", kind, width, height, values)


def _images_bin(path: Path) -> Iterator[tuple[str, np.ndarray, int]]:
    data = _Bytes(path)
    (count,) = data.take("Q")
    for _ in range(count):
        numbers = data.take("i7di")
        name = data.name()
        (points,) = data.take("Q")
        data.skip(24 * points)
        yield name, pose_of(list(numbers[1:5]), list(numbers[5:8])), numbers[8]


def _points_bin(path: Path) -> np.ndarray:
    data = _Bytes(path)
    (count,) = data.take("Q")
    out = []
    for _ in range(count):
        values = data.take("Q3d3BdQ")
        data.skip(8 * values[8])
        out.append(values[1:4])
    return np.array(out, float).reshape(-1, 3)


def _named(path: Path, model: str | int, width: int, height: int, values: list[float]) -> Lens:
    try:
        return lens_of(model, width, height, values)
    except InputError as e:
        raise InputError(f"{path}: {e}") from None
