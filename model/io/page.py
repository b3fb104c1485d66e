# SPDX-License-Identifier: GPL-3.0-or-later
"""A web page that plays an asset: one file that a browser opens from disk, without a server and without network.

It holds the asset's own .ply, packed, which can be read back, and the player of `player/`, which takes it apart and
computes place, rotation and opacity at any time on the GPU: nothing is baked, and no format of our own is added. numpy
only, for inside Blender.
"""

from __future__ import annotations

import base64
import gzip
import html
import io
import json
import re
import zlib
from pathlib import Path

import numpy as np

from ...datagen.sequence import InputError
from .asset import VISIBLE, Asset, LoadedAsset, check
from .atomic import atomic_write
from .ply import asset_bytes, asset_from_bytes

PLAYER = Path(__file__).parent / "player"
FOV = 50.0  # degrees of the picture's shorter side, as the default rig has them
MARGIN = 1.08  # how much larger than the asset the view is at first
MOST = 64  # times that packed data may grow; floats never come near it
MOMENTS = 9  # of the clip, at which is looked where the asset is


def write_page(path: str | Path, asset: Asset) -> None:
    """Writes the page, with the file's name as its title; it appears whole or not at all. Raises InputError (see
    `check`)."""
    check(asset, path)
    path = Path(path)
    parts = {
        "TITLE": html.escape(path.stem),
        "ABOUT": json.dumps(_about(asset)),
        "ASSET": base64.b64encode(gzip.compress(asset_bytes(asset), 6, mtime=0)).decode(),
        "SCRIPT": (PLAYER / "player.js").read_text("utf-8"),
    }
    page = (PLAYER / "player.html").read_text("utf-8")
    with atomic_write(path) as tmp:
        tmp.write_text(re.sub(r"\{\{([A-Z]+)\}\}", lambda m: parts[m[1]], page), "utf-8", newline="\n")


def read_page(path: Path) -> LoadedAsset:
    """The asset that a page holds. Raises InputError, also for any other page."""
    packed = re.search(rb'<script id="asset" type="text/plain">([\w+/=]+)</script>', path.read_bytes())
    if not packed:
        raise InputError(f"{path}: it is no page that Timesplat wrote; choose one of these, or the asset itself.")
    try:
        data = base64.b64decode(packed[1])
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as stream:
            ply = stream.read(MOST * len(data))
    except (ValueError, EOFError, zlib.error, OSError) as e:
        raise InputError(f"{path}: the asset in it is damaged ({e}); copy or export it again.") from None
    return LoadedAsset(asset_from_bytes(ply, path), "Z")


def _about(asset: Asset) -> dict:
    """What the player is told beside the .ply; lengths are in normalised space."""
    clip = asset.clip
    target, radius = bounds(asset)
    return {
        **{"fps": clip.fps, "start": clip.frame_start, "end": clip.frame_end, "pixel": clip.pixel, "cut": VISIBLE},
        **{"fov": FOV, "target": target, "distance": MARGIN * radius / np.sin(np.radians(FOV / 2))},
    }


def bounds(asset: Asset) -> tuple[list[float], float]:
    """Middle and radius of a ball that shows the asset through the whole clip; strays do not count."""
    clip, places = asset.clip, []
    for frame in np.linspace(clip.frame_start, clip.frame_end, MOMENTS):
        xyz, opacity = asset.at(clip.frame_to_time(frame))
        places.append(xyz[opacity >= VISIBLE])
    points = np.concatenate(places).astype(np.float64)
    points = points if len(points) else asset.xyz.astype(np.float64)
    middle = np.percentile(points, (1, 99), axis=0).mean(0)
    radius = np.percentile(np.linalg.norm(points - middle, axis=1), 99) + 3 * float(np.median(asset.scale.max(1)))
    return middle.tolist(), float(radius)
