# SPDX-License-Identifier: GPL-3.0-or-later
"""Lets an asset follow the object that it was made from, where that does not move by itself."""

from __future__ import annotations

import bpy


def follow(ob, original) -> bool:
    """Parents the asset to the original, so that moving this moves that; the asset stays where it is. Only where
    the original's transform stands still by itself: with an animated one, a constraint, a driver, physics or an
    animated parent, the motion is in the Gaussians already. Returns whether it did."""
    above = original
    while above:
        if above == ob or _is_animated(above):
            return False
        above = above.parent
    bpy.context.view_layer.update()
    ob.parent, ob.parent_type = original, "OBJECT"
    ob.matrix_parent_inverse = original.matrix_world.inverted_safe()
    return True


def _is_animated(ob) -> bool:
    if ob.constraints or ob.rigid_body or (ob.parent and ob.parent_type != "OBJECT"):
        return True
    animation = ob.animation_data
    if not animation:
        return False
    moving = ("location", "rotation", "scale", "delta_")
    if any(curve.data_path.startswith(moving) for curve in animation.drivers):
        return True
    actions = [animation.action, *(s.action for t in animation.nla_tracks for s in t.strips)]
    return any(path.startswith(moving) for a in actions if a for path in _animated_paths(a))


def _animated_paths(action) -> list[str]:
    """Data paths that an action animates; those of all its slots."""
    if not hasattr(action, "layers"):  # before Blender 4.4
        return [c.data_path for c in action.fcurves]
    strips = [s for layer in action.layers for s in layer.strips]
    return [c.data_path for s in strips for bag in s.channelbags for c in bag.fcurves]
