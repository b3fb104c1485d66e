# SPDX-License-Identifier: GPL-3.0-or-later
"""EasyMocap's cameras, and ZJU-MoCap's: a few that stand still, and film.

`intri.yml` (`K_NAME`, `dist_NAME` or `D_NAME`, perhaps `H_NAME`, `W_NAME`) and `extri.yml` (`Rot_NAME`, or `R_NAME` as
a rotation vector, `T_NAME`) in the YAML of OpenCV's FileStorage; or K, R, T and D as JSON, of each camera by its name
(`cameras.json`, `calibration.json`), or as lists beside the names of pictures (`annots.json`, ZJU's `annots.npy`).
World-to-camera, OpenCV axes. Their principal points are OpenCV's, which has pixel centres at whole numbers: half a
pixel is added. Pictures are in `images/NAME/` or `NAME/`, else videos in `videos/`.
"""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np

from ..sequence import InputError, read_from
from .lenses import Lens
from .pickled import read_pickled
from .pictures import size_of
from .posed import REMEDY, Posed, PosedScene
from .videos import SUFFIXES, video_of

PAIR = ("intri.yml", "extri.yml")
TABLES = ("annots.npy", "annots.json", "cameras.json", "calibration.json")
MASKS = ("masks", "mask", "mask_cihp", "seg")
PICTURES = (".png", ".jpg", ".jpeg", ".webp")
HOMES = ("images", "")  # of the cameras' folders
_MATRIX = re.compile(
    r"^(\S+?):\s*!!opencv-matrix\s+rows:\s*(\d+)\s+cols:\s*(\d+)\s+dt:\s*\S+\s+data:\s*\[([^\]]*)\]", re.M
)
_NUMBER = re.compile(r"^(\S+?):\s*([-+.\deE]+)\s*$", re.M)


def camera_files(folder: Path) -> list[Path]:
    """The files that describe the cameras of a folder; none where it is of another layout."""
    if all((folder / name).is_file() for name in PAIR):
        return [folder / name for name in PAIR]
    for name in TABLES:
        path = folder / name
        if path.is_file() and (path.suffix == ".npy" or _is_table(path)):
            return [path]
    return []


def _is_table(path: Path) -> bool:
    """Whether a JSON file holds such cameras: others call theirs cameras.json as well."""
    try:
        d = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return path.name.startswith("annots")  # which is damaged, and told by who reads it
    if not isinstance(d, dict):
        return False
    return isinstance(d.get("cams"), dict) or any(
        isinstance(c, dict) and {"K", "R", "T"} <= c.keys() for c in d.values()
    )


def read_easymocap(folder: Path) -> PosedScene:
    """What the cameras' files and the pictures' names say. Raises InputError naming the file and the fault."""
    files = camera_files(folder)
    if not files:
        raise InputError(f"{folder / PAIR[0]}: no such file, nor {', '.join(TABLES)}; give a folder of EasyMocap.")
    path, listed = files[0], None
    with read_from(path, REMEDY):
        if len(files) == 2:
            with read_from(files[1], REMEDY):
                outside = file_storage(files[1].read_text(encoding="utf-8"))
            cameras = _of_storage(file_storage(path.read_text(encoding="utf-8")), outside, files)
        else:
            d = read_pickled(path) if path.suffix == ".npy" else json.loads(path.read_text(encoding="utf-8"))
            if "cams" in d:
                cameras, listed = _of_lists(d)
            else:
                cameras = {str(name): dict(c) for name, c in d.items() if isinstance(c, dict)}
        if not cameras:
            raise ValueError("it has no cameras")
        scene = PosedScene(folder, path, "EasyMocap", [], axes="w2c-opencv", counted=True, upright=False)
        fill = _of_names(folder, cameras) if listed is None else listed
        for name, camera in cameras.items():
            matrix, lens = _pose(name, camera), None
            for image, frame, number in fill.get(name, []):
                lens = lens or _lens(name, camera, folder / image, number)
                scene.pictures.append(
                    Posed(
                        image if number is None else f"{image}#{number}", matrix, lens, frame=frame, camera=name,
                        mask=_mask(folder, name, image, frame), video_frame=number,
                    )
                )  # fmt: skip
                if number is not None and scene.fps is None:
                    scene.fps = video_of(folder / image).rate
    if not scene.pictures:
        names = ", ".join(list(cameras)[:3])
        raise InputError(f"{folder / 'images'}: no pictures and no videos of the cameras {names}; {REMEDY}.")
    if lacking := [name for name in cameras if not fill.get(name)]:
        scene.notes.append(f"{len(lacking)} cameras have no pictures and are left out: {', '.join(lacking[:3])}")
    return scene


def file_storage(text: str) -> dict[str, Any]:
    """The matrices (rows,cols) and numbers of a file of OpenCV's FileStorage. Raises ValueError."""
    found: dict[str, Any] = {m[1]: float(m[2]) for m in _NUMBER.finditer(text)}
    for m in _MATRIX.finditer(text):
        values = [float(x) for x in m[4].replace("\n", " ").split(",") if x.strip()]
        found[m[1]] = np.array(values).reshape(int(m[2]), int(m[3]))
    return found


def _of_storage(inside: dict[str, Any], outside: dict[str, Any], files: list[Path]) -> dict[str, dict]:
    """K, R, T, D, and H and W if known, of each camera, by its name."""
    cameras = {}
    for key in [k for k in inside if k.startswith("K_")]:
        name = key[2:]
        turn = outside.get(f"Rot_{name}", outside.get(f"R_{name}"))
        if turn is None or f"T_{name}" not in outside:
            raise InputError(f"{files[1]}: the camera {name} has no R_{name} and T_{name}; {REMEDY}.")
        bent = inside.get(f"dist_{name}", inside.get(f"D_{name}", []))
        cameras[name] = {"K": inside[key], "R": turn, "T": outside[f"T_{name}"], "D": bent}
        cameras[name] |= {k: inside[f"{k}_{name}"] for k in "HW" if f"{k}_{name}" in inside}
    return cameras


def _of_lists(d: dict) -> tuple[dict[str, dict], dict[str, list[tuple[str, float, None]]]]:
    """The cameras of ZJU's lists, and of each the pictures and their frames. A camera is called as its folder is."""
    c, moments = d["cams"], [list(m["ims"]) for m in d["ims"]]
    count = len(c["K"])
    if not moments or any(len(m) != count for m in moments):
        raise ValueError(f"its moments do not list {count} pictures, one a camera")
    names = [Path(str(p)).parent.name or f"{k:02d}" for k, p in enumerate(moments[0])]
    if len(set(names)) < count:
        names = [f"{k:02d}" for k in range(count)]
    cameras = {n: {key: c[key][k] for key in "KRTD" if key in c} for k, n in enumerate(names)}
    return cameras, {n: [(str(m[k]), float(i), None) for i, m in enumerate(moments)] for k, n in enumerate(names)}


def _of_names(folder: Path, cameras: dict) -> dict[str, list[tuple[str, float, int | None]]]:
    """The pictures of each camera, their frames, and of videos the number in it. Numbers in names count in the largest
    step that leads to all of them."""
    found: dict[str, list[tuple[str, float, int | None]]] = {}
    for home in HOMES:
        for name in cameras:
            at = folder / home / name
            files = sorted(p for p in at.iterdir() if p.suffix.lower() in PICTURES) if at.is_dir() else []
            if files:
                found[name] = [(p.relative_to(folder).as_posix(), _number(p, k), None) for k, p in enumerate(files)]
        if found:
            numbers = np.unique([int(frame) for x in found.values() for _, frame, _ in x])
            step = max(int(np.gcd.reduce(np.diff(numbers))), 1) if len(numbers) > 1 else 1
            return {n: [(image, (f - numbers[0]) / step, None) for image, f, _ in x] for n, x in found.items()}
    for home in ("videos", ""):
        for name in cameras:
            paths = (folder / home / f"{name}{suffix}" for suffix in SUFFIXES)
            if path := next((p for p in paths if p.is_file()), None):
                image = path.relative_to(folder).as_posix()
                found[name] = [(image, float(k), k) for k in range(len(video_of(path).stamps))]
        if found:
            break
    shortest = min(map(len, found.values()), default=0)  # a moment is what all have filmed
    return {name: x[:shortest] for name, x in found.items()}


def _number(path: Path, rank: int) -> float:
    digits = re.findall(r"\d+", path.stem)
    return float(digits[-1]) if digits else float(rank)


def _mask(folder: Path, camera: str, image: str, frame: float) -> str | None:
    """The mask of a picture, where there is one: beside `images/`, with the same name below."""
    path = Path(image)
    stem = f"{int(frame):06d}" if path.suffix.lower() in SUFFIXES else path.stem
    for home in MASKS:
        for suffix in (".png", ".jpg"):
            name = f"{home}/{camera}/{stem}{suffix}"
            if (folder / name).is_file():
                return name
    return None


def _pose(name: str, camera: dict) -> np.ndarray:
    """(4,4) world-to-camera. Raises ValueError for other shapes."""
    R, T = np.array(camera["R"], float), np.array(camera["T"], float).ravel()
    if R.size == 3:
        R = rotation_of(R.ravel())
    if R.shape != (3, 3) or T.shape != (3,):
        raise ValueError(f"the camera {name} has an R of {R.shape} and a T of {T.shape}, not 3x3 and 3")
    m = np.eye(4)
    m[:3, :3], m[:3, 3] = R, T
    return m


def rotation_of(vector: np.ndarray) -> np.ndarray:
    """(3,3) of a rotation vector (3,), radians around its direction (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * K + (1 - math.cos(angle)) * (K @ K)


def _lens(name: str, camera: dict, file: Path, number: int | None) -> Lens:
    """Of a camera; its size is the one stated, or that of its first picture. Raises ValueError for other shapes."""
    K, D = np.array(camera["K"], float), np.array(camera.get("D", []), float).ravel()
    if K.shape != (3, 3):
        raise ValueError(f"the camera {name} has a K of {K.shape}, not 3x3")
    if len(D) not in (0, 4, 5, 8):
        raise ValueError(f"the camera {name} has {len(D)} numbers of distortion; 4, 5 or 8 are read")
    if "W" in camera and "H" in camera and min(camera["W"], camera["H"]) > 0:
        width, height = int(camera["W"]), int(camera["H"])
    elif number is not None:
        width, height = video_of(file).width, video_of(file).height
    else:
        (width, height), _, _ = size_of(file, False, REMEDY)
    k1, k2, p1, p2, k3, *divisor = [*D, *np.zeros(5 - min(len(D), 5))]
    radial, bend = (k1, k2, k3), tuple(map(float, divisor))
    return Lens(
        width, height, float(K[0, 0]), float(K[1, 1]), float(K[0, 2]) + 0.5, float(K[1, 2]) + 0.5,
        radial=tuple(map(float, radial)) if any(radial) or any(bend) else (), divisor=bend if any(bend) else (),
        tangential=(float(p1), float(p2)),
    )  # fmt: skip
