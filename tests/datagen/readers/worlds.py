"""A scene that is known in full, photographed through any lens by any camera, and written in every layout."""

import json
import struct
from dataclasses import dataclass, replace

import numpy as np
from PIL import Image

from timesplat.datagen import rigs
from timesplat.datagen.readers.lenses import Lens
from timesplat.datagen.sequence import opengl_to_opencv

RADIUS = 0.6
BALLS = np.array([[0.0, 0.0, 0.0], [0.5, 0.2, 0.1]])  # their middles at time 0; the second moves
MOTION = np.array([[0.0, 0.0, 0.0], [0.0, -0.3, 0.3]])  # over the clip
PLAIN = Lens(24, 20, 26.0, 25.0, 12.7, 9.4)  # not square, its principal point off the middle


@dataclass
class Shot:
    c2w: np.ndarray  # (4,4) OpenGL axes
    time: float  # 0..1
    lens: Lens = PLAIN
    camera: str = "0"


def inverse(lens, u, v):
    """Pixels -> the ideal x, y at z = 1 whose rays end there, by Newton's method with differences."""
    x, y = (u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy
    for _ in range(12):
        pu, pv, _ = lens.pixels(x, y)
        h = 1e-6
        ux, vx, _ = lens.pixels(x + h, y)
        uy, vy, _ = lens.pixels(x, y + h)
        a, b, c, d = (ux - pu) / h, (uy - pu) / h, (vx - pv) / h, (vy - pv) / h
        det = a * d - b * c
        x, y = x - (d * (pu - u) - b * (pv - v)) / det, y - (a * (pv - v) - c * (pu - u)) / det
    return x, y


def photograph(shot, scale=1.0, offset=0.0, across=4):
    """(H,W,4) uint8 RGBA of the two balls, whose world is `scale` times as large and `offset` further; each pixel is
    the mean of across² rays."""
    lens = shot.lens
    n = across
    y, x = np.meshgrid((np.arange(lens.height * n) + 0.5) / n, (np.arange(lens.width * n) + 0.5) / n, indexing="ij")
    x, y = inverse(lens, x, y)
    c2w = opengl_to_opencv(shot.c2w)
    d = np.stack([x, y, np.ones_like(x)], -1) @ c2w[:3, :3].T
    o = (c2w[:3, 3] - offset) / scale
    best = np.full(x.shape, np.inf)
    rgb = np.zeros((*x.shape, 3))
    for middle, colour in zip(BALLS + MOTION * shot.time, ([220, 60, 40], [40, 90, 230]), strict=True):
        a, b = (d * d).sum(-1), (d * (o - middle)).sum(-1)
        disc = b * b - a * ((o - middle) @ (o - middle) - (RADIUS / 2) ** 2)
        t = np.where(disc > 0, (-b - np.sqrt(np.maximum(disc, 0))) / a, np.inf)
        hit = (t > 0) & (t < best)
        best[hit] = t[hit]
        rgb[hit] = colour
    alpha = np.isfinite(best).astype(float)
    mean = [
        v.reshape(lens.height, n, lens.width, n, -1).mean((1, 3)) for v in (rgb * alpha[..., None], alpha[..., None])
    ]
    straight = mean[0] / np.maximum(mean[1], 1e-9)
    return np.rint(np.concatenate([straight, 255 * mean[1]], -1)).astype(np.uint8)


def shots(count=12, moving=True, lens=PLAIN, scale=1.0, offset=0.0):
    """Cameras in every direction, each at a time of its own."""
    out = []
    for k in range(count):
        c2w = rigs.spherical(137.5 * k, 40 * np.sin(2.4 * k + 1), distance=2.4)
        c2w[:3, 3] = scale * c2w[:3, 3] + offset
        out.append(Shot(c2w, k / (count - 1) if moving else 0.0, lens, f"{k:02d}"))
    return out


def on_white(rgba):
    a = rgba[..., 3:].astype(float) / 255
    return np.rint(rgba[..., :3] * a + 255 * (1 - a)).astype(np.uint8)


def save(path, picture, **how):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture).save(path, **how)


def write_transforms(folder, taken, change=None, frame=None, **top):
    """nerfstudio's layout: `change(d)` edits all of it, `frame(k, shot)` is added to each frame."""
    lens = taken[0].lens
    d = {"camera_model": "OPENCV", "w": lens.width, "h": lens.height, "fl_x": lens.fx, "fl_y": lens.fy}
    d |= {"cx": lens.cx, "cy": lens.cy, **top, "frames": []}
    for k, s in enumerate(taken):
        f = {"file_path": f"images/{k:04d}.png", "transform_matrix": s.c2w.tolist(), "time": s.time}
        d["frames"].append(f | (frame(k, s) if frame else {}))
    if change:
        change(d)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "transforms.json").write_text(json.dumps(d))
    return folder


def write_pictures(folder, taken, scale=1.0, offset=0.0, name="images/{k:04d}.png", white=False, **how):
    for k, s in enumerate(taken):
        picture = photograph(s, scale, offset)
        save(folder / name.format(k=k, camera=s.camera), on_white(picture) if white else picture, **how)


def quaternion(R):
    """w x y z of a rotation, by the eigenvector of Bar-Itzhack's matrix."""
    (a, b, c), (d, e, f), (g, h, i) = R
    K = np.array(
        [[a - e - i, 0, 0, 0], [d + b, e - a - i, 0, 0], [g + c, h + f, i - a - e, 0], [h - f, c - g, d - b, a + e + i]]
    )
    vector = np.linalg.eigh((K + K.T - np.diag(np.diag(K))) / 3)[1][:, -1]
    return np.array([vector[3], *vector[:3]])


def write_colmap(folder, taken, names, binary=False, model=(1, "PINHOLE"), values=None, points=()):
    """COLMAP's three tables in sparse/0, one camera."""
    at = folder / "sparse" / "0"
    at.mkdir(parents=True, exist_ok=True)
    lens = taken[0].lens
    values = values or [lens.fx, lens.fy, lens.cx, lens.cy]
    poses = [np.linalg.inv(opengl_to_opencv(s.c2w)) for s in taken]
    rows = [(k + 1, *quaternion(m[:3, :3]), *m[:3, 3], 1) for k, m in enumerate(poses)]
    if not binary:
        words = " ".join(map(repr, values))
        (at / "cameras.txt").write_text(f"# a comment\n1 {model[1]} {lens.width} {lens.height} {words}\n")
        lines = [" ".join(map(repr, map(float, r))).replace(f"{r[0]}.0", str(r[0]), 1) for r in rows]
        lines = [
            " ".join([str(r[0]), *(repr(float(x)) for x in r[1:8]), "1", n]) for r, n in zip(rows, names, strict=True)
        ]
        (at / "images.txt").write_text("# a comment\n" + "".join(f"{x}\n1.5 2.5 -1\n" for x in lines))
        (at / "points3D.txt").write_text(
            "".join(f"{k} {x!r} {y!r} {z!r} 9 9 9 0.5 1 0\n" for k, (x, y, z) in enumerate(points))
        )
        return folder
    head = struct.pack("<Q", 1) + struct.pack(f"<iiQQ{len(values)}d", 1, model[0], lens.width, lens.height, *values)
    (at / "cameras.bin").write_bytes(head)
    body = b"".join(
        struct.pack("<i7di", *r) + n.encode() + b"\0" + struct.pack("<Q2dq", 1, 1.5, 2.5, -1)
        for r, n in zip(rows, names, strict=True)
    )
    (at / "images.bin").write_bytes(struct.pack("<Q", len(rows)) + body)
    body = b"".join(struct.pack("<Q3d3BdQ2i", k, *p, 9, 9, 9, 0.5, 1, 1, 0) for k, p in enumerate(points))
    (at / "points3D.bin").write_bytes(struct.pack("<Q", len(points)) + body)
    return folder


def write_panoptic(folder, groups, held_out=()):
    """groups: of each moment the shots of all cameras; those whose camera is in `held_out` are of the test file."""
    for name, held in (("train_meta.json", False), ("test_meta.json", True)):
        d = {"w": 0, "h": 0, "k": [], "w2c": [], "fn": [], "cam_id": []}
        for n, group in enumerate(groups):
            mine = [s for s in group if (s.camera in held_out) == held]
            lens = group[0].lens
            d["w"], d["h"] = lens.width, lens.height
            K = [[[s.lens.fx, 0, s.lens.cx], [0, s.lens.fy, s.lens.cy], [0, 0, 1]] for s in mine]
            d["k"].append(K)
            d["w2c"].append([np.linalg.inv(opengl_to_opencv(s.c2w)).tolist() for s in mine])
            d["fn"].append([f"{s.camera}/{6 * n:06d}.jpg" for s in mine])
            d["cam_id"].append([int(s.camera) for s in mine])
            for s in mine:
                rgba = photograph(s)
                save(folder / f"ims/{s.camera}/{6 * n:06d}.jpg", rgba[..., :3], quality=95)
                if not held:
                    save(folder / f"seg/{s.camera}/{6 * n:06d}.png", rgba[..., 3])
        (folder / name).write_text(json.dumps(d))
    return folder


def still(shot):
    return replace(shot, time=0.0)
