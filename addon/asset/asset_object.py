# SPDX-License-Identifier: GPL-3.0-or-later
"""What an asset object holds, as an Asset without its sliders, and what these are set to.

The object's own transform is no part of the asset: the asset's clip says where it was made, and an object that was
moved since stays so in Blender only.
"""

from __future__ import annotations

import bpy
import numpy as np

from ...datagen.sequence import InputError
from ...model.io.asset import Asset, Clip, check
from .attributes import read_attribute
from .sliders import SLIDERS, asset_modifier, get_input, is_asset
from .tracks import read_paths


def asset_of(ob) -> Asset:
    """The Gaussians that the object holds and the clip it remembers: what was put in, to the last bit, but for
    colours, which took the way to linear light and back (an error below 1e-6, and values outside 0..1 are
    clamped). Raises InputError where the object is no asset, or was damaged."""
    if not is_asset(ob):
        raise InputError(f"{ob.name if ob else 'Nothing'}: it is no Timesplat asset; select one.")
    try:
        return _asset(ob)
    except KeyError as e:
        raise InputError(f"{ob.name}: the attribute {e} is missing; import or reconstruct the asset again.") from None


def _asset(ob) -> Asset:
    data = ob.data
    asset = Asset(
        xyz=read_attribute(data, "position"),
        t=read_attribute(data, "gs_t"),
        velocity=read_attribute(data, "gs_velocity"),
        sigma_t=read_attribute(data, "gs_sigma_t"),
        scale=read_attribute(data, "gs_scale"),
        rotation=read_attribute(data, "gs_rotation"),
        rgb=_srgb(read_attribute(data, "gs_color")[:, :3]),
        opacity=read_attribute(data, "gs_opacity"),
        clip=_clip(ob),
        **read_paths(ob),
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
    start, end = (round(get_input(asset_modifier(ob), f"Frame {x}")) for x in ("Start", "End"))
    fps = bpy.context.scene.render.fps / bpy.context.scene.render.fps_base
    return Clip(fps, start, end, ob.scale[0], tuple(ob.location))  # made by an older version, which noted no clip


def slider_values(ob) -> dict:
    """The modifier's inputs by name, as they are at this moment (an animated one has its present value)."""
    modifier = asset_modifier(ob)
    return {name: get_input(modifier, name) for name in SLIDERS}
