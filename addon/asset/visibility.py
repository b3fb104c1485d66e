# SPDX-License-Identifier: GPL-3.0-or-later
"""Original or reconstruction: which of them 3D views and renders show.

What is hidden because its reconstruction is shown bears the custom property HIDDEN, and is captured all the same.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

HIDDEN = "timesplat_hidden"


def show(ob, originals: Iterable, what: str, context) -> None:
    """Shows the asset object `ob` (RESULT), what it was made from (ORIGINAL) or BOTH, in the view layer and in renders.
    RESULT hides the asset objects of earlier reconstructions of the same too."""
    originals = list(originals)
    for original in originals:
        _hide(original, what == "RESULT", context)
        if original.is_editable:
            original[HIDDEN] = what == "RESULT"
    _hide(ob, what == "ORIGINAL", context)
    if what == "RESULT":
        names = {o.name for o in originals}
        for other in context.scene.objects:
            if other != ob and other.get("timesplat") and names & set(other.get("timesplat_source", ())):
                _hide(other, True, context)


def shown(ob, context) -> str:
    """What `show` would have to be told for what is shown now."""
    objects = context.scene.objects
    if ob.hide_render:
        return "ORIGINAL"
    hidden = any(name in objects and objects[name].get(HIDDEN) for name in ob.get("timesplat_source", ())[:1])
    return "RESULT" if hidden else "BOTH"


@contextmanager
def captured(objects: Iterable) -> Iterator[None]:
    """Within it renders show what is only hidden because its reconstruction is shown."""
    hidden = [o for o in objects if o.get(HIDDEN) and o.hide_render]
    for ob in hidden:
        ob.hide_render = False
    try:
        yield
    finally:
        for ob in hidden:
            ob.hide_render = True


def _hide(ob, hide: bool, context) -> None:
    if ob.name in context.view_layer.objects:
        ob.hide_set(hide)
    if ob.is_editable:  # what is linked from another file is not
        ob.hide_render = hide
