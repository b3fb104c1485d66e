# SPDX-License-Identifier: GPL-3.0-or-later
"""What the preferences' buttons do: install the model runtime, take it away, test it."""


def draw(layout) -> None:
    """The part of the preferences below the settings."""
