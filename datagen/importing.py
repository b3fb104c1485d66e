# SPDX-License-Identifier: GPL-3.0-or-later
"""A Sequence that others wrote, as one of ours: its pictures as they are read, in files of their own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from .image_files import write_png
from .sequence import Sequence, write_sequence


def import_sequence(seq: Sequence, out: Path, progress: Callable[[float, str], None] | None = None) -> Sequence:
    """Writes the Sequence's pictures, cameras and moments into the folder `out`, whole or not at all, and returns it as
    read back. progress(fraction, text) is called between pictures. Depth and tracks are not taken along: others have
    none. Raises InputError for a picture that cannot be read, and where `out` is something else."""
    views = [replace(v, image=f"images/{k:05d}.png", passes=None) for k, v in enumerate(seq.views)]
    mine = replace(seq, views=views, tracks=None, untracked=[], picture=None, root=None, remedy=Sequence.remedy)

    def fill(folder: Path) -> None:
        (folder / "images").mkdir()
        for k, v in enumerate(views):
            if progress:
                progress(k / len(views), "writing pictures")
            write_png(folder / v.image, seq.load_image(k))

    return write_sequence(mine, out, fill)
