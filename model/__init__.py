# SPDX-License-Identifier: GPL-3.0-or-later
"""First floor: views become Gaussians4D become views. torch; never bpy."""
