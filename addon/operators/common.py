# SPDX-License-Identifier: GPL-3.0-or-later
"""What several operators share."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from ...datagen.sequence import InputError
from ..asset.sliders import is_asset


class OnAsset:
    """An operator that works on the active asset object, in Object Mode."""

    @classmethod
    def poll(cls, context):
        return context.mode == "OBJECT" and is_asset(context.object)


@contextmanager
def errors_reported(operator) -> Iterator[None]:
    """An InputError becomes the operator's report, and what follows the block is for that case."""
    try:
        yield
    except InputError as e:
        operator.report({"ERROR"}, str(e))


@contextmanager
def wait_cursor(context) -> Iterator[None]:
    """The mouse pointer says that Blender is busy."""
    if window := context.window:  # none in background
        window.cursor_modal_set("WAIT")
    try:
        yield
    finally:
        if window:
            window.cursor_modal_restore()
