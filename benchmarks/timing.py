# SPDX-License-Identifier: GPL-3.0-or-later
"""How the benchmarks take a time."""

from __future__ import annotations

import math
import time
from collections.abc import Callable


def least(call: Callable[[], object], seconds: float = 0.0, clock: Callable[[], float] = time.process_time) -> float:
    """Seconds of call(), the least of at least three calls, and of as many as start within `seconds` (on the wall)
    after the first, which may have compiled something. clock: processor time, or time.perf_counter."""
    taken, end = [], math.inf
    while len(taken) < 3 or time.perf_counter() < end:
        start = clock()
        call()
        taken.append(clock() - start)
        if len(taken) == 1:
            end = time.perf_counter() + seconds
    return min(taken)
