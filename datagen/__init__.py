# SPDX-License-Identifier: GPL-3.0-or-later
"""Ground floor: a Blender scene becomes a Sequence. bpy, numpy, OpenEXR; never torch."""

ASSET_SUFFIXES = (".blend", ".glb", ".gltf", ".fbx", ".obj", ".usd", ".usda", ".usdc", ".usdz")  # what it opens
