# SPDX-License-Identifier: GPL-3.0-or-later
"""What runs outside the artist's Blender: Jobs, their processes, and the installed model runtime."""
