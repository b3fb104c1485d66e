# SPDX-License-Identifier: GPL-3.0-or-later
"""Colours that a file gives its vertices, and that the importers of OBJ, FBX and USD read but show to no render."""

from __future__ import annotations

import bpy
import numpy as np

_WHITE = 0.999


def show_vertex_colours() -> None:
    """Paints the meshes of the open, imported scene by their first colour attribute where nothing else says how they
    look: where there is no material, or one whose base colour is a plain grey. A colour or a texture of the material's
    is meant; and colours that are white throughout say nothing."""
    painted: dict = {}  # (material or None, attribute) -> the material that shows the attribute
    for ob in bpy.data.objects:
        if ob.type != "MESH" or not (name := _colours(ob.data)):
            continue
        if not ob.material_slots:
            ob.data.materials.append(None)
        for slot in ob.material_slots:
            if slot.material is None or _is_plain(slot.material):
                key = (slot.material, name)
                if key not in painted:
                    painted[key] = _painted(*key)
                slot.material = painted[key]


def _colours(mesh) -> str | None:
    """The name of the mesh's colours, None where it has none or they are all white."""
    attributes = mesh.color_attributes
    index = attributes.render_color_index
    if not len(attributes):
        return None
    colours = attributes[index if 0 <= index < len(attributes) else 0]
    values = np.empty(4 * len(colours.data), np.float32)
    colours.data.foreach_get("color", values)
    return colours.name if len(values) and values.reshape(-1, 4)[:, :3].min() < _WHITE else None


def _principled(material):
    nodes = material.node_tree.nodes if material.node_tree else ()
    return next((n for n in nodes if n.type == "BSDF_PRINCIPLED"), None)


def _is_plain(material) -> bool:
    shader = _principled(material)
    if shader is None or shader.inputs["Base Color"].is_linked:
        return False
    red, green, blue, _ = shader.inputs["Base Color"].default_value
    return max(red, green, blue) - min(red, green, blue) < 1e-3 and min(red, green, blue) > 0


def _painted(material, attribute: str):
    """A copy of the material, or a new one, whose base colour is the attribute."""
    material = material.copy() if material else bpy.data.materials.new("vertex colours")
    if bpy.app.version < (5, 0):  # from then on it always has nodes
        material.use_nodes = True
    nodes, shader = material.node_tree.nodes, _principled(material)
    colour = nodes.new("ShaderNodeVertexColor")
    colour.layer_name = attribute
    material.node_tree.links.new(colour.outputs["Color"], shader.inputs["Base Color"])
    return material
