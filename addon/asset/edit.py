# SPDX-License-Identifier: GPL-3.0-or-later
"""Changes to what an asset object holds: fewer Gaussians, and the sliders' effect for good."""

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Matrix

from ...datagen.sequence import InputError
from .apply_sliders import with_sliders
from .asset_object import slider_values
from .attributes import KINDS, read_attribute, write_attributes
from .display import add_asset, point_cloud
from .sliders import asset_modifier, set_input


def keep_gaussians(ob, mask: np.ndarray, context=None) -> None:
    """Throws away the Gaussians of the object's data where `mask` (N,) is false, for all objects that share the
    data. Attributes, materials and names stay; so does all that belongs to the object. Needs Object Mode. Raises
    InputError where nothing would be left or the data is linked from another file."""
    context = context or bpy.context
    old = ob.data
    if not mask.any():
        raise InputError(f"{ob.name}: no Gaussian would be left; delete the object instead, or choose fewer.")
    if old.library or old.override_library:
        raise InputError(f"{ob.name}: its data is linked from another file; make it local first.")
    kept = []
    for attribute in old.attributes:
        if attribute.domain != "POINT" or attribute.data_type not in KINDS or attribute.name.startswith("."):
            continue
        kept.append((attribute.name, attribute.data_type, read_attribute(old, attribute.name)[mask]))
    xyz = next(values for name, _, values in kept if name == "position")

    active, selected = context.view_layer.objects.active, [o for o in context.view_layer.objects.selected if o]
    helper = point_cloud(xyz, old.name, context)  # a PointCloud cannot be resized before Blender 5.2
    new = helper.data
    write_attributes(new, kept)
    for material in old.materials:
        new.materials.append(material)
    for key, value in old.items():
        new[key] = value.to_dict() if hasattr(value, "to_dict") else value
    name = old.name
    old.user_remap(new)
    bpy.data.objects.remove(helper)
    # not batch_remove: undo after it has crashed Blender 4.3
    (bpy.data.meshes if isinstance(old, bpy.types.Mesh) else bpy.data.pointclouds).remove(old)
    new.name = name
    for other in selected:
        other.select_set(True)
    context.view_layer.objects.active = active


def bake(ob, frames: tuple[int, int], context=None):
    """A new object in place of `ob`, which is hidden: see `with_sliders`. It is where `ob` is, and follows it where
    that is animated. Raises InputError."""
    asset, s = with_sliders(ob, frames), slider_values(ob)
    new = add_asset(asset, f"{ob.name} baked", look=s["Look"], cut=s["Opacity Cut"], context=context)
    set_input(asset_modifier(new), "Point Size", s["Point Size"])
    for key, value in ob.items():
        if key.startswith("timesplat_") and key != "timesplat_clip":
            new[key] = value
    if ob.animation_data or ob.constraints:
        new.parent = ob
        new.matrix_basis = Matrix()
    else:
        new.parent, new.parent_type, new.parent_bone = ob.parent, ob.parent_type, ob.parent_bone
        new.matrix_parent_inverse, new.matrix_basis = ob.matrix_parent_inverse, ob.matrix_basis
    ob.hide_set(True)
    ob.hide_render = True
    return new
