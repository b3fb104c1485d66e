# SPDX-License-Identifier: GPL-3.0-or-later
"""The sliders of an asset object, which are inputs of the modifier that plays it: what there is (see nodes.py for what
each does), and how to read and set them."""

from __future__ import annotations

from typing import NamedTuple

import bpy

from ...model.io.asset import VISIBLE

# Blender 5.3 draws point clouds of a type of their own as splats. It takes the attributes scale (σ), rotation and
# radiance:base (the constant spherical harmonic of sRGB colour, opacity), as its importers of .ply and USD write
# them (Blender's source: io/ply/importer/ply_import_gsplat.cc, nodes/geometry/nodes/node_geo_points_type.cc).
NATIVE = bpy.app.version >= (5, 3) and hasattr(bpy.types, "GeometryNodePointsSetType")
LOOKS = ("Automatic", "Points", "Splats", "Ellipsoids", *(["Native"] if NATIVE else []))
REPEATS = ("Hold", "Loop", "Ping-Pong")
MENUS = {"Look": LOOKS, "Repeat": REPEATS}


class Slider(NamedTuple):
    panel: str  # in the modifier
    socket: str  # its kind
    default: object
    lowest: float | None
    highest: float | None
    description: str


SLIDERS = {
    "Look": Slider("", "Menu", "Automatic", None, None, "Automatic: Ellipsoids in the viewport, Splats in renders"),
    "Opacity Cut": Slider("", "Float", VISIBLE, 0, 1, "Gaussians fainter than this at a moment are left out"),
    "Point Size": Slider("", "Float", 1.5, 0, 100, "Radius of ellipsoids and points, in standard deviations"),
    "Density": Slider("", "Float", 1.0, 0, 1, "Share of the Gaussians that is shown"),
    "Frame Start": Slider("Time", "Float", 0.0, -1e6, 1e6, "Scene frame at which the clip starts"),
    "Frame End": Slider("Time", "Float", 23.0, -1e6, 1e6, "Scene frame at which the clip ends"),
    "Time Offset": Slider("Time", "Float", 0.0, -1e6, 1e6, "The clip starts this many frames later"),
    "Time Scale": Slider("Time", "Float", 1.0, -100, 100, "Speed: 2 is twice as fast, negative is backwards"),
    "Repeat": Slider("Time", "Menu", "Hold", None, None, "What happens beyond the ends of the clip"),
    "Lifetime Scale": Slider("Time", "Float", 1.0, 0.01, 100, "How long each Gaussian is visible, times this"),
    "Crop": Slider("Crop", "Bool", False, None, None, "Leave out what lies outside the box"),
    "Crop Min": Slider("Crop", "Vector", (-1.0,) * 3, -1e6, 1e6, "Lower corner of the box, in units of the clip"),
    "Crop Max": Slider("Crop", "Vector", (1.0,) * 3, -1e6, 1e6, "Upper corner of the box, in units of the clip"),
}


def is_asset(ob) -> bool:
    """Whether the object holds Gaussians, so that its sliders are there to be drawn."""
    return bool(ob and ob.get("timesplat") and asset_modifier(ob))


def asset_modifier(ob):
    """The modifier that plays the asset; None if there is none."""
    for modifier in ob.modifiers:
        if modifier.type == "NODES" and modifier.node_group and modifier.node_group.name.startswith("Timesplat "):
            return modifier
    return None


def input_property(modifier, name: str) -> tuple:
    """(owner, property) of an input for `layout.prop` and `keyframe_insert`, None where the modifier's node
    group is an older one that lacks it. Blender 5.2 moved inputs into RNA."""
    for item in modifier.node_group.interface.items_tree:
        if item.item_type == "SOCKET" and item.in_out == "INPUT" and item.name == name:
            if hasattr(modifier, "properties"):
                return getattr(modifier.properties.inputs, item.identifier), "value"
            return modifier, f'["{item.identifier}"]'
    return None


def set_input(modifier, name: str, value) -> None:
    """Sets an input of the modifier by the name it shows. A menu takes an item's name or its index."""
    owner, key = input_property(modifier, name)
    if name in MENUS:
        items = MENUS[name]
        index = items.index(value) if isinstance(value, str) else value
        value = index if owner == modifier else items[index]
    if key == "value":
        owner.value = value
    else:
        owner[key[2:-2]] = value
    modifier.id_data.update_tag()


def get_input(modifier, name: str):
    """The input's value: a number, a bool, a tuple of three, the name of a menu's item, or of Paths (tracks.py) an
    object or None; the default where the node group lacks the input."""
    slider, found = SLIDERS.get(name), input_property(modifier, name)
    if found is None:
        return slider and slider.default
    owner, key = found
    value = owner.value if key == "value" else owner.get(key[2:-2])
    if name in MENUS:
        return value if isinstance(value, str) else MENUS[name][value]
    return tuple(value) if slider and slider.socket == "Vector" else value
