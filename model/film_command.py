# SPDX-License-Identifier: GPL-3.0-or-later
"""`timesplat video`: which cameras, how large, over what; see film.py."""

from __future__ import annotations

import argparse
import json
import math
import re
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..datagen.rigs import Shot
from ..datagen.sequence import InputError, Sequence
from .io.asset import Asset


def add_arguments(p: argparse.ArgumentParser) -> None:
    from .io.export import add_asset_arguments

    add_asset_arguments(p)
    p.add_argument("out", type=Path, help=".mp4, animated .webp, or a name without suffix: a folder of .png with alpha")
    p.add_argument("--camera", metavar="CAMERAS", help="in place of the turntable what these see: a folder of pictures "
                   "with cameras, such as `timesplat render` writes (FOLDER, or FOLDER:NAME for one camera), or a "
                   ".json with a list \"frames\" of {\"frame\": 1, \"transform_matrix\": 4x4 in the world, as "
                   "Blender has it, \"camera_angle_x\": radians of the longer side}")  # fmt: skip
    p.add_argument("--size", help="pixels, as 512 or 1280x720 (default: 512, or that of the folder's pictures)")
    p.add_argument("--fps", type=float, help="pictures a second; more than the clip's are between its frames (default: "
                   "the clip's)")  # fmt: skip
    p.add_argument("--background", help="a colour as ffffff, or none: transparent, but in .mp4 (default: white, and "
                   "none for .png)")  # fmt: skip
    p.add_argument("--plays", type=int, help="how often the clip plays in one turn of the turntable (default: as often "
                   "as takes four seconds)")  # fmt: skip


def run(args: argparse.Namespace, bar: Callable[[], AbstractContextManager[Callable[[float, str], None]]]) -> int:
    """0. `bar` shows how far the film is. Raises InputError before anything is drawn."""
    from .film import Look, check_look, placed, turntable, write_film
    from .io.export import read_upright

    check_look(args.out, Look())  # its suffix, before the asset is read
    if args.plays is not None and (args.camera or args.plays < 1):
        raise InputError("video: --plays is for the turntable, and 1 or more; drop it.")
    asset = read_upright(args.asset, args.up)
    fps = args.fps if args.fps is not None else asset.clip.fps
    look = replace(Look(), fps=fps, background=background(args.background, args.out))
    check_look(args.out, look)
    if args.camera:
        shots, (width, height) = cameras(args.camera)
        shots = placed(between(shots, asset, fps), asset)
    else:
        shots, (width, height) = turntable(asset, fps, args.plays), (look.width, look.height)
    width, height = size(args.size, width, height)
    look = replace(look, width=width, height=height)
    with bar() as progress:
        count = write_film(args.out, asset, shots, look, progress)
    print(f"{args.out}: {count} pictures of {width} x {height}, {count / fps:.1f} s")
    return 0


def background(said: str | None, out: Path) -> tuple[float, float, float] | None:
    """-> sRGB-encoded in 0..1, or None: transparent. Raises InputError."""
    if said is None:
        return None if not out.suffix else (1.0, 1.0, 1.0)
    if said == "none":
        return None
    if not re.fullmatch(r"#?[0-9a-fA-F]{6}", said):
        raise InputError(f"{said}: give a background as six hexadecimal digits such as 17191c, or none.")
    red, green, blue = bytes.fromhex(said.removeprefix("#"))
    return red / 255, green / 255, blue / 255


def size(said: str | None, width: int, height: int) -> tuple[int, int]:
    """Width and height; one number is the longer side of what is there already. Raises InputError."""
    if said is None:
        return width, height
    if not re.fullmatch(r"[0-9]{1,5}(x[0-9]{1,5})?", said):
        raise InputError(f"{said}: give a size as 512 or 1280x720.")
    if "x" in said:
        wide, high = map(int, said.split("x"))
        return wide, high
    scale = int(said) / max(width, height)
    return max(round(width * scale), 1), max(round(height * scale), 1)


def between(shots: list[Shot], asset: Asset, fps: float) -> list[Shot]:
    """The shots as they are, where a picture for each is the clip's rate; else, with another, each repeated or left out
    as often as keeps their pace."""
    rate = fps / asset.clip.fps
    if abs(rate - 1) < 1e-6:
        return shots
    return [shots[min(int(i / rate), len(shots) - 1)] for i in range(max(round(len(shots) * rate), 1))]


def cameras(said: str) -> tuple[list[Shot], tuple[int, int]]:
    """Cameras in the world, in the order of their frames, and the size of their pictures. Raises InputError."""
    path = Path(said)
    if path.suffix.lower() == ".json" and path.name != "transforms.json":
        return read_cameras(path), (512, 512)
    folder, _, name = said.rpartition(":") if not path.exists() and ":" in said else (said, "", "")
    from ..datagen.readers import open_sequence

    seq = open_sequence(Path(folder).parent if Path(folder).name == "transforms.json" else Path(folder))
    names = sorted({v.camera for v in seq.views})
    if name and name not in names:
        raise InputError(f"{folder}: no camera {name}; it has {', '.join(names[:9])}{' …' if names[9:] else ''}.")
    views = sorted((v for v in seq.views if not name or v.camera == name), key=lambda v: v.frame)
    return [_shot(v, seq) for v in views], (seq.width, seq.height)


def _shot(view, seq: Sequence) -> Shot:
    longer = max(seq.width, seq.height)
    fov = math.degrees(2 * math.atan(0.5 * longer / view.fx))
    shift = (seq.width / 2 - view.cx) / longer, (view.cy - seq.height / 2) / longer
    return Shot(view.frame, view.camera, "film", seq.normalisation.to_world(view.c2w), fov, shift)


def read_cameras(path: Path) -> list[Shot]:
    """Cameras of a .json (see `add_arguments`), in the world. Raises InputError naming the file."""
    try:
        listed = json.loads(path.read_text("utf-8"))["frames"]
        shots = []
        for entry in listed:
            c2w = np.array(entry["transform_matrix"], np.float64)
            turn = c2w[:3, :3]
            angle, shift = float(entry["camera_angle_x"]), entry.get("shift", (0.0, 0.0))
            if c2w.shape != (4, 4) or not np.isfinite(c2w).all() or not 0 < angle < math.pi:
                raise ValueError(f"camera {len(shots)} is no 4x4 matrix of numbers with an angle within 0 to pi")
            if np.abs(turn @ turn.T - np.eye(3)).max() > 1e-3 or np.linalg.det(turn) < 0:
                raise ValueError(f"camera {len(shots)} is scaled, sheared or mirrored")
            fov, (right, up) = math.degrees(angle), map(float, shift)
            shots.append(Shot(float(entry["frame"]), "film", "film", c2w, fov, (right, up)))
    except OSError as e:
        raise InputError(f"{path}: it cannot be read ({e.strerror or e}); check the name.") from None
    except (ValueError, KeyError, TypeError) as e:
        raise InputError(f"{path}: it is no list of cameras ({e}); see `timesplat video --help`.") from None
    if not shots:
        raise InputError(f"{path}: it has no cameras; see `timesplat video --help`.")
    return shots
