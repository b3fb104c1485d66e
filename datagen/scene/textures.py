# SPDX-License-Identifier: GPL-3.0-or-later
"""Textures that are not there, or not to be read: light grey in their place, where Blender would render magenta, and a
sentence."""

from __future__ import annotations

import os
from pathlib import Path

import bpy

OUTSIDE = "timesplat-outside"  # the file that an importer is told in place of one that it must not read
_GREY = (0.8, 0.8, 0.8, 1.0)
_GREY_DATA = (0.8, 0.8, 0.0, 1.0)  # as glTF packs it: rough, and no metal
_FROM_FILES = ("FILE", "SEQUENCE", "MOVIE", "TILED")


def within(root: Path, file: Path) -> bool:
    """Whether a path leads to a place below `root`, links followed."""
    return Path(file).resolve().is_relative_to(root)


def replace_missing_textures(path: Path, root: Path) -> list[str]:
    """Light grey for each texture of the open file that is missing, damaged or outside of `root`, and for those nodes
    that the importer left without one; what they bend is no longer bent. A sentence for each, that names the asset
    `path`."""
    warnings, grey = [], []
    for image in bpy.data.images:
        if image.source not in _FROM_FILES or not image.users:
            continue
        file = Path(bpy.path.abspath(image.filepath, library=image.library)) if image.filepath else None
        fault = _fault(image, file, root)
        if fault:
            warnings.append(f"{path}: the texture {image.name} {fault}")
            _make_grey(image)
            grey.append(image)
    for tree, owner in _trees():
        for node in [n for n in tree.nodes if n.type == "TEX_IMAGE"]:
            if node.image is None and any(output.is_linked for output in node.outputs):
                what = f"the {node.label.lower()} texture" if node.label else "a texture"
                warnings.append(f"{path}: {what} of {owner} cannot be read; it is rendered light grey.")
                node.image = bpy.data.images.new("timesplat", 1, 1)
                _make_grey(node.image)
                grey.append(node.image)
            if node.image in grey:
                _straighten(tree, node)
    return list(dict.fromkeys(warnings))


def _fault(image, file: Path | None, root: Path) -> str:
    """The end of the sentence on what is wrong with an image; "" where nothing is. An importer's place-holder holds
    pixels although its file is missing."""
    if not image.packed_file and file:
        if file.name == OUTSIDE or (not within(root, file) and os.path.lexists(file)):
            return f"lies outside of {root}; it is rendered light grey, give a --root that holds it."
        if image.source in ("FILE", "MOVIE") and not file.is_file():
            return "is missing; it is rendered light grey."
    if image.has_data or image.size[0]:  # size[0] makes Blender try to load it
        return ""
    return "is missing or damaged; it is rendered light grey."


def _make_grey(image) -> None:
    data = image.colorspace_settings.is_data
    if image.packed_file:
        image.unpack(method="REMOVE")
    image.source = "GENERATED"
    image.generated_width = image.generated_height = 1
    image.pixels[:] = _GREY_DATA if data else _GREY  # its generated colour would go through the scene's view


def _trees() -> list:
    """(node tree, name of what it belongs to) of all materials and node groups."""
    trees = [(m.node_tree, m.name) for m in bpy.data.materials if m.node_tree]
    return trees + [(group, group.name) for group in bpy.data.node_groups if group.bl_idname == "ShaderNodeTree"]


def _straighten(tree, node) -> None:
    """Grey is no normal and no height: the surface that the missing image bends stays as it is."""
    bent = [link.to_node for output in node.outputs for link in output.links]
    for bend in [n for n in bent if n.type in ("NORMAL_MAP", "BUMP", "DISPLACEMENT")]:
        for link in [x for output in bend.outputs for x in output.links]:
            tree.links.remove(link)
