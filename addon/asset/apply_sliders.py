# SPDX-License-Identifier: GPL-3.0-or-later
"""What the sliders of an asset object show, in numbers: at a moment, and for good, as an Asset.

The arithmetic of nodes.py over again, in numpy; `s` are the sliders' values by name.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...datagen.sequence import InputError
from ...model.io.asset import ARRAYS, STATIC_SIGMA_T, Asset, Clip, check
from ...model.io.placement import place_asset
from .asset_object import asset_of, read_attribute, slider_values
from .sliders import SLIDERS

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
        mask = read_attribute(ob.data, "gs_order", 1, "value") < np.float32(s["Density"])
    return mask & in_crop_box(asset, s) if s["Crop"] else mask


def shown_gaussians(ob, frame: float) -> tuple[np.ndarray, np.ndarray]:
    """(N,3) positions in normalised space of ALL Gaussians at a scene frame, and (N,) which of them the
    modifier shows then."""
    position, _, seen = _shown_at(ob, asset_of(ob), slider_values(ob), frame)
    return position, seen


def _shown_at(ob, asset: Asset, s: dict, frame: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    lives = replace(asset, sigma_t=asset.sigma_t * np.float32(s["Lifetime Scale"]))
    position, alpha = lives.at(model_time(s, frame))
    return position, alpha, _chosen_gaussians(ob, asset, s) & (alpha >= np.float32(s["Opacity Cut"]))


def moment(ob, asset: Asset, frame: float, apply_sliders: bool = True) -> Asset:
    """What the timeline shows of `asset_of(ob)` at the scene's present frame, as an asset in the world that does not
    change, whatever Repeat is or is animated. It holds no Gaussian fainter than Opacity Cut, but a clear one where
    nothing is shown: empty files are refused by many. Raises InputError."""
    clip = asset.clip
    own = {"Frame Start": clip.frame_start, "Frame End": clip.frame_end}
    s = slider_values(ob) if apply_sliders else {k: v.default for k, v in SLIDERS.items()} | own
    position, alpha, seen = _shown_at(ob, asset, s, frame)
    matrix = np.array(ob.matrix_world)
    if not seen.any() or abs(np.linalg.det(matrix[:3, :3])) < 1e-27:
        matrix, seen, alpha = np.eye(4), np.arange(len(asset)) == 0, np.zeros(len(asset))
    return place_asset(_masked(_without_time(asset, position, alpha), seen), matrix)


def peak_opacity(asset: Asset) -> np.ndarray:
    """(N,) the highest opacity of each Gaussian within the clip."""
    short = np.maximum(np.abs(asset.t) - 1, 0) / asset.sigma_t
    with np.errstate(under="ignore"):
        return asset.opacity * np.exp(-0.5 * short**2)


def with_sliders(ob, frames: tuple[int, int] | None = None) -> Asset:
    """The asset with the sliders' effect for good; `frames`: only these scene frames, both included.

    Density, Crop and Lifetime Scale are exact. Time Offset and Time Scale become another clip and another rate of
    time: the asset shows at each scene frame of its clip what the object shows there. A clip has whole frames at its
    ends: where a retimed one ends between two, it ends at the frame before. What never reaches Opacity Cut is
    left out; the rest fades out as usual, below the cut too. Point Size and Look are no part of an asset.
    Raises InputError where Repeat is not Hold, or nothing is left."""
    asset, s = asset_of(ob), slider_values(ob)
    if s["Repeat"] != "Hold":
        raise InputError(f"{ob.name}: Repeat is {s['Repeat']}, and an asset only holds at its ends; set it to Hold, or "
                         "export 3DGS PLY, all frames.")  # fmt: skip
    asset = _masked(asset, _chosen_gaussians(ob, asset, s))
    asset.sigma_t = asset.sigma_t * np.float32(s["Lifetime Scale"])
    if len(asset):
        asset = _retimed(asset, s, frames)
        asset = _masked(asset, peak_opacity(asset) >= np.float32(s["Opacity Cut"]))
    if not len(asset):
        raise InputError(f"{ob.name}: no Gaussian is left; lower Opacity Cut, or change Density and Crop.")
    check(asset, ob.name)
    return asset


def _masked(asset: Asset, mask: np.ndarray) -> Asset:
    return replace(asset, **{name: getattr(asset, name)[mask] for name in ARRAYS})


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
        return _frozen(asset, model_time(s, first), clip)
    clip = replace(asset.clip, frame_start=first, frame_end=last)
    a = speed * (last - first) / length
    b = 2 * speed * (first - start) / length - 1 + a
    return replace(
        asset,
        t=((asset.t.astype(np.float64) - b) / a).astype(np.float32),
        sigma_t=(asset.sigma_t.astype(np.float64) / abs(a)).astype(np.float32),
        velocity=(asset.velocity.astype(np.float64) * a).astype(np.float32),
        clip=clip,
    )


def _frozen(asset: Asset, time: float, clip: Clip) -> Asset:
    """What is there at one time, for all time."""
    return replace(_without_time(asset, *asset.at(time)), clip=clip)


def _without_time(asset: Asset, position: np.ndarray, alpha: np.ndarray) -> Asset:
    """It is there with these opacities for all time."""
    n = len(asset)
    still = {"t": np.zeros(n), "velocity": np.zeros((n, 3)), "sigma_t": np.full(n, STATIC_SIGMA_T), "opacity": alpha}
    return replace(asset, xyz=position, **{key: a.astype(np.float32) for key, a in still.items()})
