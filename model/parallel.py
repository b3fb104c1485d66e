# SPDX-License-Identifier: GPL-3.0-or-later
"""Compiled kernels on several threads, and the clock that their work is measured by."""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor

import torch

_pool = (None, 0, 0)  # executor, the process that made it, its threads


def parallel_for(jobs: Iterable[tuple], work: Callable) -> list:
    """work(*job) for every job, on as many threads as torch uses; they take the next job when they are free.
    Returns the results in the order of the jobs, and raises what a job raises.

    The compiled functions release the GIL. Not numba's own threads: they are a second pool that spins against
    torch's, die in forked processes, cannot be entered by two threads at once, and double the compile time."""
    global _pool
    jobs = list(jobs)
    threads = min(torch.get_num_threads(), len(jobs))
    if threads < 2:
        return [work(*job) for job in jobs]
    if _pool[1:] != (os.getpid(), torch.get_num_threads()):
        _pool = ThreadPoolExecutor(torch.get_num_threads()), os.getpid(), torch.get_num_threads()
    counter, results = itertools.count(), [None] * len(jobs)

    def take_jobs():
        while (i := next(counter)) < len(jobs):
            results[i] = work(*jobs[i])

    helpers = [_pool[0].submit(take_jobs) for _ in range(threads - 1)]
    take_jobs()
    for helper in helpers:
        helper.result()
    return results


def chunks(count: int, size: int) -> list[tuple[int, int]]:
    """0..count in consecutive ranges (first, end), end exclusive, of at most `size`."""
    return [(a, min(a + size, count)) for a in range(0, count, size)]


def work_clock() -> float:
    """Seconds to measure work by: processor time where one thread does it (then what else the machine does at the
    same time neither lengthens a measure nor shortens a fit), wall-clock time where several do, or a GPU."""
    alone = torch.get_num_threads() == 1 and not torch.cuda.is_initialized()
    return time.process_time() if alone else time.perf_counter()
