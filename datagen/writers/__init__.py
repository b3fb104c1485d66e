# SPDX-License-Identifier: GPL-3.0-or-later
"""The way back: a Sequence in the layouts of other programs, so that these read it as it is.

Cameras are written in the Sequence's normalised world, whose unit box is what those programs expect an object in.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ..importing import import_sequence
from ..sequence import InputError, Sequence
from ..whole_folders import whole_folder
from .colmap import write_colmap, write_frames
from .panoptic import write_panoptic
from .pictures import Progress
from .transforms import write_dnerf, write_nerfstudio

SEQUENCE = "sequence"


@dataclass(frozen=True)
class Layout:
    """One of other programs."""

    write: Callable[[Sequence, Path, Progress], None]  # into an empty folder
    mark: str  # the file by which a folder of it is known
    text: str


LAYOUTS = {
    "dnerf": Layout(write_dnerf, "transforms_train.json", "D-NeRF, for hustvl's 4DGaussians and nerfstudio"),
    "nerfstudio": Layout(write_nerfstudio, "transforms.json", "nerfstudio's transforms.json"),
    "colmap": Layout(write_colmap, "sparse/0/images.txt", "COLMAP's sparse/0 and images/, the frame in each name"),
    "panoptic": Layout(write_panoptic, "train_meta.json", "Panoptic, as Dynamic 3D Gaussians reads it"),
    "frames": Layout(write_frames, "transforms.json", "every frame in a folder of its own, with COLMAP's tables"),
}  # fmt: skip
NAMES = (SEQUENCE, *LAYOUTS)


def layout_argument(p: argparse.ArgumentParser) -> None:
    """`--layout` of a command that writes Sequences."""
    words = "; ".join(f"{name}: {layout.text}" for name, layout in LAYOUTS.items())
    p.add_argument("--layout", choices=NAMES, default=SEQUENCE, help=f"what is written: {SEQUENCE}, ours (default); "
                   f"{words}")  # fmt: skip


def write_layout(seq: Sequence, out: Path, name: str, progress: Progress | None = None) -> None:
    """Writes a Sequence into the folder `out` in one of the layouts NAMES, whole or not at all.
    progress(fraction, text) is called between pictures. Raises InputError for another name, a picture that cannot be
    read, and where `out` is something else."""
    progress = progress or (lambda fraction, text: None)
    if name == SEQUENCE:
        import_sequence(seq, out, progress)
        return
    if name not in LAYOUTS:
        raise InputError(f"--layout {name}: no such layout; choose {', '.join(NAMES)}.")
    layout = LAYOUTS[name]
    with whole_folder(Path(out), layout.mark, f"a folder in the layout {name}") as tmp:
        layout.write(seq, tmp, progress)
