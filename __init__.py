# SPDX-License-Identifier: GPL-3.0-or-later
"""Timesplat: posed images at any times in, a 4D Gaussian asset out.

This folder is at once the Python package `timesplat` and the Blender extension. Inside Blender
(where it is imported as `bl_ext.<repository>.timesplat`) it also registers the add-on.
"""

__version__ = "0.1.0"

if __name__.startswith("bl_ext."):
    from .addon import register, unregister  # noqa: F401
