# SPDX-License-Identifier: GPL-3.0-or-later
"""A Blender scene: how an asset is opened, played, measured and lent out."""
