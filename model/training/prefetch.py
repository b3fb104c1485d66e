# SPDX-License-Identifier: GPL-3.0-or-later
"""Samples of the steps to come, drawn by processes beside the one that trains."""

from __future__ import annotations

import itertools
import signal
from collections.abc import Iterator

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from ...datagen.sequence import InputError
from .dataset import ClipDataset, Sample

AHEAD = 2  # samples that each process keeps ready


class _Draws(Dataset):
    """Sample number i of a run, with the generator that drew it, as it then stands; or the InputError that came of it,
    whose sentence would be lost in what DataLoader makes of one."""

    def __init__(self, clips: ClipDataset, seed: int, first: int, accumulate: int, inputs: int, targets: int):
        self.clips, self.seed, self.first, self.accumulate = clips, seed, first, accumulate
        self.counts = {"inputs": inputs, "targets": targets}

    def __getitem__(self, i: int) -> tuple[Sample, np.random.Generator] | InputError:
        step, n = divmod(i, self.accumulate)
        rng = np.random.default_rng((self.seed, step, self.first + n))
        try:
            return self.clips.sample(rng, **self.counts), rng
        except InputError as e:
            return e


def samples(
    clips: ClipDataset, *, seed: int, step: int, rank: int, accumulate: int, inputs: int, targets: int, workers: int
) -> Iterator[tuple[Sample, np.random.Generator]]:
    """All samples from a step on, `accumulate` a step, each with the generator that drew it. They are seeded by the
    step and their number in it, over all processes that train (this one's `rank`): a resumed run draws what an unbroken
    one would have, and two processes what one with twice the samples would. workers: processes that draw them, of
    which each has at most AHEAD ready; 0: this one does. Raises InputError as `ClipDataset.sample` does."""
    draws = _Draws(clips, seed, rank * accumulate, accumulate, inputs, targets)
    loader: DataLoader = DataLoader(
        draws,
        batch_size=None,
        sampler=itertools.count(step * accumulate),  # type: ignore[arg-type]
        num_workers=workers,
        prefetch_factor=AHEAD if workers else None,
        generator=torch.Generator(),  # else it would take its seed from that of the run
        collate_fn=_as_it_is,
        worker_init_fn=_ignore_interrupt,
    )
    for drawn in loader:
        if isinstance(drawn, InputError):
            raise drawn
        yield drawn


def _as_it_is(drawn):
    return drawn


def _ignore_interrupt(worker: int) -> None:
    """Ctrl-C reaches all processes; the one that trains ends the others when its step is done."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
