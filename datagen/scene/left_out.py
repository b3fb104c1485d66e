# SPDX-License-Identifier: GPL-3.0-or-later
"""What Blender left out of an open file without a word: linked libraries that are not there, and drivers that would be
scripts. A sentence each."""

from __future__ import annotations

from pathlib import Path

import bpy

from .textures import within


def left_out(path: Path, root: Path) -> list[str]:
    """The warnings, that name the asset `path`. A library outside of the folder `root` is taken out."""
    warnings = []
    for library in list(bpy.data.libraries):
        file = Path(bpy.path.abspath(library.filepath))
        if not file.is_file():
            warnings.append(f"{path}: the linked library {library.filepath} is missing; what it holds is not rendered.")
        elif not within(root, file):
            warnings.append(
                f"{path}: the linked library {library.filepath} lies outside of {root}; what it holds is not rendered, "
                "give a --root that holds it."
            )
            bpy.data.libraries.remove(library)
    scripted = sorted({owner for owner, driver in _drivers() if _is_script(driver)})
    if scripted:
        names = ", ".join(scripted[:5]) + (" and others" if len(scripted) > 5 else "")
        warnings.append(f"{path}: scripted drivers of {names} did not run, for files execute nothing; bake them.")
    return warnings


def _drivers() -> list:
    """(name of the data-block, driver) of all in the file."""
    blocks = [x for kind in dir(bpy.data) for x in _blocks(getattr(bpy.data, kind))]
    blocks += [m.node_tree for m in bpy.data.materials if m.node_tree]
    animated = [x for x in blocks if getattr(x, "animation_data", None)]
    return [(x.name, curve.driver) for x in animated for curve in x.animation_data.drivers]


def _blocks(collection) -> list:
    return list(collection) if isinstance(collection, bpy.types.bpy_prop_collection) else []


def _is_script(driver) -> bool:
    """Whether it needs Python, which Blender runs only for files that are trusted."""
    return driver.type == "SCRIPTED" and not driver.is_simple_expression
