# SPDX-License-Identifier: GPL-3.0-or-later
"""The one door to Sequences on disk, whoever wrote them: which of the readers a folder is for. Without torch."""

from __future__ import annotations

import os
from pathlib import Path

from ..sequence import InputError, Sequence, read_sequence
from .dnerf import SPLITS, read_dnerf

OURS, DNERF = "transforms.json", "transforms_train.json"


def open_sequence(folder: Path) -> Sequence:
    """The Sequence in a folder: `transforms.json` is our own format, else `transforms_train.json` that of D-NeRF and
    NeRF's synthetic scenes. Raises InputError where there is neither, and as `read_sequence` and `read_dnerf` do."""
    folder = Path(folder)
    if (folder / OURS).is_file():
        return read_sequence(folder)
    if (folder / DNERF).is_file():
        return read_dnerf(folder)
    raise InputError(
        f"{folder / OURS}: no such file, nor {DNERF}; give a folder that `timesplat render` wrote, or one in the "
        "format of D-NeRF."
    )


def sequences_in(root: Path) -> list[Path]:
    """The folders of Sequences at any depth of `root`, itself included, sorted. Hidden folders are left out: a Sequence
    is rendered in one and renamed when it is whole, perhaps at this moment."""
    found = []
    for folder, below, files in os.walk(root):
        below[:] = [name for name in below if not name.startswith(".")]
        if not {OURS, DNERF}.isdisjoint(files):
            found.append(Path(folder))
    return sorted(found)


def described_by(folder: Path) -> list[Path]:
    """The files that say what the Sequence in a folder is; a change of it shows in them."""
    names = [OURS] if (folder / OURS).is_file() else [f"transforms_{split}.json" for split in SPLITS]
    return [folder / name for name in names if (folder / name).is_file()]


def name_of(folder: Path) -> str:
    """What a Sequence is called: ours by the folder above, which is the object's (its own is the clip's), others by
    their own."""
    folder = folder.absolute()
    return folder.parent.name if (folder / OURS).is_file() else folder.name
