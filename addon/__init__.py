# SPDX-License-Identifier: GPL-3.0-or-later
"""Top floor, what an artist sees: import, display and the Reconstruct panel. bpy; never torch."""


def register() -> None:
    """Registers operators, panel and menu entry with Blender."""
    from . import importer, reconstruct

    importer.register()
    reconstruct.register()


def unregister() -> None:
    """Takes back what `register` did, and ends workers that still run."""
    from . import importer, reconstruct

    reconstruct.unregister()
    importer.unregister()
