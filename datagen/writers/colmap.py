# SPDX-License-Identifier: GPL-3.0-or-later
"""COLMAP's tables as text: of a whole clip, and of every frame by itself.

One PINHOLE camera for each inside that differs; world-to-camera with OpenCV axes. Names are `frame_0012_front.png`, all
in one folder, for some programs drop what is before. `points3D` holds points of the object's hull, to start from.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..sequence import Sequence, opengl_to_opencv
from .pictures import Progress, camera_names, frame_names, put
from .points import start_points
from .transforms import write_transforms


def write_colmap(seq: Sequence, folder: Path, progress: Progress) -> None:
    """Into an empty folder. Raises InputError for a picture that cannot be read."""
    (folder / "images").mkdir()
    moments, cameras = frame_names(seq), camera_names(seq)
    names = [f"frame_{moments[v.frame]}_{c}.png" for v, c in zip(seq.views, cameras, strict=True)]
    for i, name in enumerate(names):
        progress(i / len(names), "writing pictures")
        put(seq, i, folder / "images" / name)
    _tables(seq, folder / "sparse/0", list(range(len(names))), names, start_points(seq))


def write_frames(seq: Sequence, folder: Path, progress: Progress) -> None:
    """`frame_0012/images/front.png` and `frame_0012/sparse/0`, of every frame, and over them one transforms.json in
    nerfstudio's layout. Into an empty folder. Raises InputError for a picture that cannot be read."""
    moments, cameras = frame_names(seq), camera_names(seq)
    points = start_points(seq)
    names = [f"frame_{moments[v.frame]}/images/{c}.png" for v, c in zip(seq.views, cameras, strict=True)]
    for n, (frame, word) in enumerate(moments.items()):
        progress(n / len(moments), "writing frames")
        home, views = folder / f"frame_{word}", seq.select(frame=frame)
        (home / "images").mkdir(parents=True)
        for i in views:
            put(seq, i, folder / names[i])
        _tables(seq, home / "sparse/0", views, [f"{cameras[i]}.png" for i in views], points)
    write_transforms(seq, folder, names)


def _tables(seq: Sequence, at: Path, views: list[int], names: list[str], points: tuple[np.ndarray, np.ndarray]) -> None:
    """cameras.txt, images.txt and points3D.txt of the views, whose pictures are called `names`."""
    at.mkdir(parents=True)
    insides: dict[tuple[float, ...], int] = {}
    rows = []
    for n, (i, name) in enumerate(zip(views, names, strict=True), 1):
        v = seq.views[i]
        camera = insides.setdefault((v.fx, v.fy, v.cx, v.cy), len(insides) + 1)
        w2c = np.linalg.inv(opengl_to_opencv(v.c2w))
        numbers = " ".join(repr(float(x)) for x in (*quaternion_of(w2c[:3, :3]), *w2c[:3, 3]))
        rows.append(f"{n} {numbers} {camera} {name}\n\n")  # its second line lists points, of which it has none
    (at / "images.txt").write_text("# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n" + "".join(rows))
    lines = [
        f"{n} PINHOLE {seq.width} {seq.height} {' '.join(repr(float(x)) for x in inside)}\n"
        for inside, n in insides.items()
    ]
    (at / "cameras.txt").write_text("# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n" + "".join(lines))
    lines = [
        f"{n} {x:.6f} {y:.6f} {z:.6f} {r} {g} {b} 0\n"
        for n, ((x, y, z), (r, g, b)) in enumerate(zip(*points, strict=True), 1)
    ]
    (at / "points3D.txt").write_text("# POINT3D_ID, X, Y, Z, R, G, B, ERROR\n" + "".join(lines))


def quaternion_of(R: np.ndarray) -> np.ndarray:
    """(4,) w x y z, w >= 0, of a rotation (3,3): the eigenvector of Bar-Itzhack's matrix."""
    (a, b, c), (d, e, f), (g, h, i) = R
    K = np.array([
        [a - e - i, d + b, g + c, h - f],
        [d + b, e - a - i, h + f, c - g],
        [g + c, h + f, i - a - e, d - b],
        [h - f, c - g, d - b, a + e + i],
    ])  # fmt: skip
    x, y, z, w = np.linalg.eigh(K / 3)[1][:, -1]
    q = np.array([w, x, y, z])
    return q if w >= 0 else -q
