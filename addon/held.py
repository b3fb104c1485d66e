# SPDX-License-Identifier: GPL-3.0-or-later
"""What an asset object holds, as an Asset: without its sliders, and with them.

The object's own transform is no part of the asset: the asset's clip says where it was made, and an object that was
moved since stays so in Blender only.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import bpy
import numpy as np

from ..datagen.sequence import InputError
from ..model.io.asset import ARRAYS, STATIC_SIGMA_T, Asset, Clip, check
from ..model.io.placement import place_asset
from . import display, nodes

FRAME = 1e-3  # frames: sliders are float32, so that a clip's end may miss a whole frame by as much


# ---------------------------------------------------------------- reading


def read(data, name: str, width: int, key: str) -> np.ndarray:
    """An attribute as float32 (N,) or, for a width above 1, (N,width)."""
    attribute = data.attributes[name]
    values = np.empty(len(attribute.data) * width, np.float32)
    attribute.data.foreach_get(key, values)
    return values.reshape(-1, width) if width > 1 else values


def asset_of(ob) -> Asset:
    """The Gaussians that the object holds and the clip it remembers: what was put in, to the last bit, but for
    colours, which took the way to linear light and back (an error below 1e-6, and values outside 0..1 are
    clamped). Raises InputError where the object is no asset, or was damaged."""
    if not display.is_asset(ob):
        raise InputError(f"{ob.name if ob else 'Nothing'}: it is no Timesplat asset; select one.")
    try:
        return _asset(ob)
    except KeyError as e:
        raise InputError(f"{ob.name}: the attribute {e} is missing; import or reconstruct the asset again.") from None


def _asset(ob) -> Asset:
    data = ob.data
    asset = Asset(
        xyz=read(data, "position", 3, "vector"),
        t=read(data, "gs_t", 1, "value"),
        velocity=read(data, "gs_velocity", 3, "vector"),
        sigma_t=read(data, "gs_sigma_t", 1, "value"),
        scale=read(data, "gs_scale", 3, "vector"),
        rotation=read(data, "gs_rotation", 4, "value"),
        rgb=_srgb(read(data, "gs_color", 4, "color")[:, :3]),
        opacity=read(data, "gs_opacity", 1, "value"),
        clip=_clip(ob),
    )
    check(asset, ob.name)
    return asset


def _srgb(linear: np.ndarray) -> np.ndarray:
    x = linear.astype(np.float64)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055).astype(np.float32)


def _clip(ob) -> Clip:
    if "timesplat_clip" in ob:
        found = ob["timesplat_clip"].to_dict()
        return Clip(**{**found, "translation": tuple(found["translation"])})
    start, end = (round(nodes.get_input(display.sampler(ob), f"Frame {x}")) for x in ("Start", "End"))
    fps = bpy.context.scene.render.fps / bpy.context.scene.render.fps_base
    return Clip(fps, start, end, ob.scale[0], tuple(ob.location))  # made by an older version, which noted no clip


def sliders(ob) -> dict:
    """The modifier's inputs by name, as they are at this moment (an animated one has its present value)."""
    modifier = display.sampler(ob)
    return {name: nodes.get_input(modifier, name) for name in nodes.SLIDERS}


# ---------------------------------------------------------------- the sliders in numbers


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


def in_box(asset: Asset, s: dict) -> np.ndarray:
    """(N,) whether a Gaussian's own position lies in the crop box, its faces included."""
    low, high = (np.float32(s[f"Crop {x}"]) for x in ("Min", "Max"))
    return ((asset.xyz >= low) & (asset.xyz <= high)).all(1)


def _chosen(ob, asset: Asset, s: dict) -> np.ndarray:
    """(N,) which Gaussians Density and Crop leave in, at any time."""
    mask = np.ones(len(asset), bool)
    if "gs_order" in ob.data.attributes:
        mask = read(ob.data, "gs_order", 1, "value") < np.float32(s["Density"])
    return mask & in_box(asset, s) if s["Crop"] else mask


def shown(ob, frame: float) -> tuple[np.ndarray, np.ndarray]:
    """(N,3) positions in normalised space of ALL Gaussians at a scene frame, and (N,) which of them the
    modifier shows then."""
    position, _, seen = _shown(ob, asset_of(ob), sliders(ob), frame)
    return position, seen


def _shown(ob, asset: Asset, s: dict, frame: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    lives = replace(asset, sigma_t=asset.sigma_t * np.float32(s["Lifetime Scale"]))
    position, alpha = lives.at(model_time(s, frame))
    return position, alpha, _chosen(ob, asset, s) & (alpha >= np.float32(s["Opacity Cut"]))


def moment(ob, asset: Asset, frame: float, apply_sliders: bool = True) -> Asset:
    """What the timeline shows of `asset_of(ob)` at the scene's present frame, as an asset in the world that does not
    change, whatever Repeat is or is animated. It holds no Gaussian fainter than Opacity Cut, but a clear one where
    nothing is shown: empty files are refused by many. Raises InputError."""
    clip = asset.clip
    own = {"Frame Start": clip.frame_start, "Frame End": clip.frame_end}
    s = sliders(ob) if apply_sliders else {k: v[2] for k, v in nodes.SLIDERS.items()} | own
    position, alpha, seen = _shown(ob, asset, s, frame)
    matrix = np.array(ob.matrix_world)
    if not seen.any() or abs(np.linalg.det(matrix[:3, :3])) < 1e-27:
        matrix, seen, alpha = np.eye(4), np.arange(len(asset)) == 0, np.zeros(len(asset))
    return place_asset(_masked(_still(asset, position, alpha), seen), matrix)


# ---------------------------------------------------------------- over the timeline


def may_change(ob) -> bool:
    """Whether the object's place or its sliders might change with the frame: quick, and True in doubt."""
    above = ob
    while above:
        bound = above.constraints or above.rigid_body or (above.parent and above.parent_type != "OBJECT")
        if above.animation_data or bound:
            return True
        above = above.parent
    return False


def steps(frames: Iterable[int], context) -> Iterator[int]:
    """Takes the scene to each of the frames, and back in the end."""
    scene = context.scene
    now = scene.frame_current, scene.frame_subframe
    try:
        for frame in frames:
            scene.frame_set(frame)
            yield frame
    finally:
        scene.frame_set(now[0], subframe=now[1])


def peak(asset: Asset) -> np.ndarray:
    """(N,) the highest opacity of each Gaussian within the clip."""
    short = np.maximum(np.abs(asset.t) - 1, 0) / asset.sigma_t
    with np.errstate(under="ignore"):
        return asset.opacity * np.exp(-0.5 * short**2)


def applied(ob, frames: tuple[int, int] | None = None) -> Asset:
    """The asset with the sliders' effect for good; `frames`: only these scene frames, both included.

    Density, Crop and Lifetime Scale are exact. Time Offset and Time Scale become another clip and another rate of
    time: the asset shows at each scene frame of its clip what the object shows there. A clip has whole frames at its
    ends: where a retimed one ends between two, it ends at the frame before. What never reaches Opacity Cut is
    left out; the rest fades out as usual, below the cut too. Point Size and Look are no part of an asset.
    Raises InputError where Repeat is not Hold, or nothing is left."""
    asset, s = asset_of(ob), sliders(ob)
    if s["Repeat"] != "Hold":
        raise InputError(f"{ob.name}: Repeat is {s['Repeat']}, and an asset only holds at its ends; set it to Hold, or "
                         "export 3DGS PLY, all frames.")  # fmt: skip
    asset = _masked(asset, _chosen(ob, asset, s))
    asset.sigma_t = asset.sigma_t * np.float32(s["Lifetime Scale"])
    if len(asset):
        asset = _retimed(asset, s, frames)
        asset = _masked(asset, peak(asset) >= np.float32(s["Opacity Cut"]))
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
    first, last = int(np.ceil(ends[0] - FRAME)), int(np.floor(ends[1] + FRAME))
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
    return replace(_still(asset, *asset.at(time)), clip=clip)


def _still(asset: Asset, position: np.ndarray, alpha: np.ndarray) -> Asset:
    """It is there with these opacities for all time."""
    n = len(asset)
    still = {"t": np.zeros(n), "velocity": np.zeros((n, 3)), "sigma_t": np.full(n, STATIC_SIGMA_T), "opacity": alpha}
    return replace(asset, xyz=position, **{key: a.astype(np.float32) for key, a in still.items()})
