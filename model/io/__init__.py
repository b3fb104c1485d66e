# SPDX-License-Identifier: GPL-3.0-or-later
"""Files of 4D Gaussian assets: numpy and the standard library (pxr for USD), so that all of it runs inside Blender."""
