# SPDX-License-Identifier: GPL-3.0-or-later
"""Top floor, what an artist sees: cameras, Reconstruct, the result, import and export. bpy; never torch."""

from importlib import import_module

# In the order in which they are registered; what comes later may use what comes before.
MODULES = (
    *("ui.preferences", "settings", "operators.import_asset", "runtime.jobs", "operators.job_operators"),
    *("operators.runtime_buttons", "operators.add_cameras", "runtime.background_blender", "operators.reconstruct"),
    *("command_line", "operators.presets", "ui.panel", "operators.view_colours", "operators.delete", "operators.bake"),
    *("ui.result_panel", "operators.compare", "operators.export_asset", "operators.export_video", "estimates"),
)


def register() -> None:
    """Registers operators, panels and menu entries with Blender."""
    for name in MODULES:
        import_module(f".{name}", __package__).register()


def unregister() -> None:
    """Takes back what `register` did, and ends child processes that still run."""
    for name in reversed(MODULES):
        import_module(f".{name}", __package__).unregister()
