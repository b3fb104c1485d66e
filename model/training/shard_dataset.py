# SPDX-License-Identifier: GPL-3.0-or-later
"""Training data out of shards that `timesplat pack` wrote: the manifest is read once, and of a clip the views that a
sample takes, wherever in its shard they lie. So what is drawn depends on the sample's seed alone, and nothing is kept.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from ...datagen.sequence import InputError
from ...datagen.shards import MANIFEST, Clip, PackedSequence, read_manifest
from ..views import load_views, shrink
from .clip_groups import GROUPS, group_probabilities
from .dataset import ClipDataset, Sample
from .view_sampling import ClipLayout, sample_views


class ShardDataset(ClipDataset):
    """Random samples of clips in shards; their groups are those that the manifest names."""

    def __init__(
        self,
        folders: Iterable[Path],
        shrink: int = 1,
        sampling: str = "setups",
        mix: str = "uniform",
        has_depth: bool = True,
    ):
        """folders: of `timesplat pack`, each with its manifest; the rest as for ClipDataset. Raises InputError where
        there is no clip, none that the mix would draw, or one without the passes that are needed."""
        self.shrink, self.sampling, self.has_depth = shrink, sampling, has_depth
        self.groups: dict[str, list[tuple[Path, Clip]]] = {g: [] for g in GROUPS}
        for folder in folders:
            for clip in read_manifest(folder / MANIFEST):
                if has_depth and not clip.passes:
                    raise InputError(
                        f"{folder}: {clip.name} was packed without passes, which --source given and --geometric need; "
                        "pack it with them, or train with --source sweep or predicted alone."
                    )
                if clip.set not in GROUPS:
                    raise InputError(f"{folder / MANIFEST}: {clip.set} is no set; pack again.")
                self.groups[clip.set].append((folder, clip))
        self.probabilities = group_probabilities(mix, {g: len(clips) for g, clips in self.groups.items()})

    def _read(self, clip: tuple[Path, Clip], rng: np.random.Generator, targets: int, inputs: int) -> Sample:
        seq = PackedSequence.open(*clip)
        names = sorted({v.camera for v in seq.views})
        frames = np.array([v.frame - seq.frame_start for v in seq.views])
        name = str(seq.provenance.get("asset", clip[1].name))
        layout = ClipLayout(frames, np.array([names.index(v.camera) for v in seq.views]), names, name)
        input_rows, target_rows = sample_views(self.sampling, rng, layout, inputs, targets)
        seen = shrink(load_views(seq, input_rows, self.has_depth), self.shrink)
        return Sample(seen, shrink(load_views(seq, target_rows), self.shrink), name)


def holds_shards(folder: Path) -> bool:
    """Whether a folder is one of `timesplat pack`."""
    return (Path(folder) / MANIFEST).is_file()
