# SPDX-License-Identifier: GPL-3.0-or-later
"""What the sliders of an asset object show, in numbers: at a moment, and for good, as an Asset.

The arithmetic of nodes.py over again, in numpy; `s` are the sliders' values by name.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...datagen.sequence import InputError
from ...model.io.asset import STATIC_SIGMA_T, Asset, check
from ...model.io.paths import WINDOW_SLACK
from ...model.io.placement import place_asset
from .asset_object import asset_of, slider_values
from .attributes import read_attribute
from .sliders import SLIDERS
from .tracks import retimed

FRAME_TOLERANCE = 1e-3  # frames: sliders are float32, so that a clip's end may miss a whole frame by as much


def clip_frame(s: dict, frame: float) -> float:
    """Frames since the clip's start that the sliders `s` show at a scene frame; see nodes.py."""
    length = max(s["Frame End"] - s["Frame Start"], 0)
    since = (frame - s["Frame Start"] - s["Time Offset"]) * s["Time Scale"]
    if s["Repeat"] == "Loop":
        return min(since % (length + 1), length)
    if s["Repeat"] == "Ping-Pong" and length:
        return length - abs(since % (2 * length) - length)
    return min(max(since, 0), length)


def model_time(s: dict, frame: float) -> float:
    """Model time, -1..1, that the sliders show at a scene frame."""
    length = max(s["Frame End"] - s["Frame Start"], 0)
    return 2 * clip_frame(s, frame) / length - 1 if length else 0.0


def in_crop_box(asset: Asset, s: dict) -> np.ndarray:
    """(N,) whether a Gaussian's own position lies in the crop box, its faces included."""
    low, high = (np.float32(s[f"Crop {x}"]) for x in ("Min", "Max"))
    return ((asset.xyz >= low) & (asset.xyz <= high)).all(1)


def _chosen_gaussians(ob, asset: Asset, s: dict) -> np.ndarray:
    """(N,) which Gaussians Density and Crop leave in, at any time."""
    mask = np.ones(len(asset), bool)
    if "gs_order" in ob.data.attributes:
        mask = read_attribute(ob.data, "gs_order") < np.float32(s["Density"])
    return mask & in_crop_box(asset, s) if s["Crop"] else mask


def shown_gaussians(ob, frame: float) -> tuple[np.ndarray, np.ndarray]:
    """(N,3) positions in normalised space of ALL Gaussians at a scene frame, and (N,) which of them the
    modifier shows then."""
    still, seen = _shown_at(ob, asset_of(ob), slider_values(ob), frame)
    return still.xyz, seen


def _shown_at(ob, asset: Asset, s: dict, frame: float) -> tuple[Asset, np.ndarray]:
    """All Gaussians as they are at a scene frame, for all time, and (N,) which of them are shown."""
    time, lives = model_time(s, frame), replace(asset, sigma_t=asset.sigma_t * np.float32(s["Lifetime Scale"]))
    still = _frozen(lives, time)
    seen = _chosen_gaussians(ob, asset, s) & (still.opacity >= np.float32(s["Opacity Cut"]))
    return still, seen if asset.paths is None else seen & asset.paths.there(time)[asset.path]


def moment(ob, asset: Asset, frame: float, apply_sliders: bool = True) -> Asset:
    """What the timeline shows of `asset_of(ob)` at the scene's present frame, as an asset in the world that does not
    change, whatever Repeat is or is animated. It holds no Gaussian fainter than Opacity Cut, but a clear one where
    nothing is shown: empty files are refused by many. Raises InputError."""
    clip = asset.clip
    own = {"Frame Start": clip.frame_start, "Frame End": clip.frame_end}
    s = slider_values(ob) if apply_sliders else {k: v.default for k, v in SLIDERS.items()} | own
    still, seen = _shown_at(ob, asset, s, frame)
    matrix = np.array(ob.matrix_world)
    if not seen.any() or abs(np.linalg.det(matrix[:3, :3])) < 1e-27:
        matrix, seen = np.eye(4), np.arange(len(asset)) == 0
        still.opacity = np.zeros_like(still.opacity)
    return place_asset(still[seen], matrix)


def peak_opacity(asset: Asset) -> np.ndarray:
    """(N,) the highest opacity of each Gaussian within the clip."""
    if asset.paths is not None:
        p = asset.paths
        return asset.opacity * ((p.start <= 1 + WINDOW_SLACK) & (p.end >= -1 - WINDOW_SLACK))[asset.path]
    short = np.maximum(np.abs(asset.t) - 1, 0) / asset.sigma_t
    with np.errstate(under="ignore"):
        return asset.opacity * np.exp(-0.5 * short**2)


def with_sliders(ob, frames: tuple[int, int] | None = None) -> Asset:
    """The asset with the sliders' effect for good; `frames`: only these scene frames, both included.

    Density, Crop and Lifetime Scale are exact. Time Offset and Time Scale become another clip and another rate of
    time: the asset shows at each scene frame of its clip what the object shows there. A clip has whole frames at its
    ends: where a retimed one ends between two, it ends at the frame before. What never reaches Opacity Cut is
    left out; the rest fades out as usual, below the cut too. Paths are retimed with what rides on them. Point Size and
    Look are no part of an asset.
    Raises InputError where Repeat is not Hold, or nothing is left."""
    asset, s = asset_of(ob), slider_values(ob)
    if s["Repeat"] != "Hold":
        raise InputError(f"{ob.name}: Repeat is {s['Repeat']}, and an asset only holds at its ends; set it to Hold, or "
                         "export 3DGS PLY, all frames.")  # fmt: skip
    asset = asset[_chosen_gaussians(ob, asset, s)]
    asset.sigma_t = asset.sigma_t * np.float32(s["Lifetime Scale"])
    if len(asset):
        asset = _retimed(asset, s, frames)
        asset = asset[peak_opacity(asset) >= np.float32(s["Opacity Cut"])]
    if not len(asset):
        raise InputError(f"{ob.name}: no Gaussian is left; lower Opacity Cut, or change Density and Crop.")
    check(asset, ob.name)
    return asset


def _retimed(asset: Asset, s: dict, frames: tuple[int, int] | None) -> Asset:
    """Model time is `a` times the new one plus `b`."""
    start, speed = s["Frame Start"] + s["Time Offset"], s["Time Scale"]
    length = max(s["Frame End"] - s["Frame Start"], 0)
    moves = length > 0 and speed != 0
    ends = sorted((start, start + length / speed)) if moves else frames or (start, start + length)
    first, last = int(np.ceil(ends[0] - FRAME_TOLERANCE)), int(np.floor(ends[1] + FRAME_TOLERANCE))
    if frames and moves:
        first, last = max(first, frames[0]), min(last, frames[1])
    if moves and last <= first:  # of the clip there is one frame, or none: its end is held
        first = last = first if first == last or not frames else frames[0]
    if last <= first or not moves:
        clip = replace(asset.clip, frame_start=first, frame_end=max(first, last))
        return replace(_frozen(asset, model_time(s, first)), clip=clip)
    clip = replace(asset.clip, frame_start=first, frame_end=last)
    a = speed * (last - first) / length
    b = 2 * speed * (first - start) / length - 1 + a
    shorter = abs(a) if asset.paths is None else 1  # on paths there is no lifetime
    return replace(
        asset,
        t=((asset.t.astype(np.float64) - b) / a).astype(np.float32),
        sigma_t=(asset.sigma_t.astype(np.float64) / shorter).astype(np.float32),
        velocity=(asset.velocity.astype(np.float64) * a).astype(np.float32),
        paths=asset.paths and retimed(asset.paths, a, b),
        clip=clip,
    )


def _frozen(asset: Asset, time: float) -> Asset:
    """What is there at one time, for all time: it rides on no path any more."""
    (position, alpha), n = asset.at(time), len(asset)
    still = {"xyz": position, "rotation": asset.rotation_at(time), "opacity": alpha}
    still |= {"t": np.zeros(n), "velocity": np.zeros((n, 3)), "sigma_t": np.full(n, STATIC_SIGMA_T)}
    return replace(asset, **{key: a.astype(np.float32) for key, a in still.items()}, path=None, paths=None)
