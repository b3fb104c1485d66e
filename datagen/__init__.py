# SPDX-License-Identifier: GPL-3.0-or-later
"""Ground floor: a Blender scene becomes a Sequence. bpy, numpy, OpenEXR; never torch."""

# of the files that can be opened
ASSET_SUFFIXES = (".blend", ".glb", ".gltf", ".fbx", ".obj", ".usd", ".usda", ".usdc", ".usdz")
