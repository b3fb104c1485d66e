# SPDX-License-Identifier: GPL-3.0-or-later
"""The asset as an object of the scene: a point cloud, its node group, what it holds."""
