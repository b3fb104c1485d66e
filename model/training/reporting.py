# SPDX-License-Identifier: GPL-3.0-or-later
"""What a training run tells of itself: where its time goes, and the lines of log.jsonl."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
import torch

from .run_state import RunState

STAGES = ("data", "geometry", "network", "raster")  # of a step; each sample passes through all


class StepResult(NamedTuple):
    """Means over the samples of a step whose loss was finite; NaN where there was none."""

    loss: float
    psnr: float  # dB, of the target views
    learned: bool  # whether the step changed the weights


class StageTimer:
    """Seconds that were spent on each of STAGES since the last `reset`."""

    def __init__(self, device: str):
        self.device = device
        self.reset()

    def reset(self) -> None:
        self.seconds = dict.fromkeys(STAGES, 0.0)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        start = self._now()
        yield
        self.seconds[name] += self._now() - start

    def _now(self) -> float:
        """Seconds, once the device has done what it was given."""
        if self.device.startswith("cuda"):
            torch.cuda.synchronize()
        return time.perf_counter()

    @property
    def total(self) -> float:
        return sum(self.seconds.values())

    @property
    def fractions(self) -> dict[str, float]:
        """The share of each stage, 0..1."""
        return {k: s / max(self.total, 1e-9) for k, s in self.seconds.items()}


def report_line(state: RunState, results: Sequence[StepResult], samples: int, timer: StageTimer) -> dict:
    """A line of the log: means over the last steps' results, of `samples` samples in all; seconds by the clock and of
    processor time (under load only the latter compares) since the start of the run; memory in MB, the highest so far;
    steps and samples that were left out; the share of each stage."""
    loss, psnr = np.mean([(r.loss, r.psnr) for r in results if math.isfinite(r.loss)] or [(math.nan, math.nan)], axis=0)
    line = {"step": state.step, "seconds": round(state.seconds, 1), "cpu_seconds": round(state.cpu_seconds, 1)}
    line |= {"loss": round(float(loss), 5), "psnr": round(float(psnr), 3)}
    line |= {"samples_per_s": round(samples / max(timer.total, 1e-9), 2), "memory": peak_memory()}
    if timer.device.startswith("cuda"):
        line["cuda_memory"] = round(torch.cuda.max_memory_allocated(timer.device) / 2**20)
    line |= {"skipped": state.skipped_steps, "bad": state.nonfinite_samples}
    line["share"] = {k: round(x, 3) for k, x in timer.fractions.items()}
    return line


def peak_memory() -> int:
    """MB that this process has held at most; 0 where the system does not say (Windows)."""
    try:
        import resource
    except ImportError:
        return 0
    unit = 2**20 if sys.platform == "darwin" else 2**10
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit)
