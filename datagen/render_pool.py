# SPDX-License-Identifier: GPL-3.0-or-later
"""Jobs to child processes of this machine, so many at a time. `ray_pool` hands them out to many machines instead."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from queue import SimpleQueue

from .render_child import Limits, render_job


class LocalPool:
    """As a context: an exception inside kills the children that run."""

    def __init__(self, jobs: int, limits: Limits) -> None:
        self.limits = limits
        self.pool = ThreadPoolExecutor(jobs)
        self.running: set[subprocess.Popen] = set()
        self.messages: SimpleQueue[dict] = SimpleQueue()
        self.free_cores: SimpleQueue[list[int]] = SimpleQueue()
        for i in range(jobs):  # one core each: twice as efficient as threads that wait for each other
            self.free_cores.put([cores()[i % len(cores())]] if jobs > 1 else [])

    def __enter__(self) -> LocalPool:
        return self

    def __exit__(self, kind, error, traceback) -> None:
        if kind:
            self.pool.shutdown(wait=False, cancel_futures=True)
            for process in list(self.running):
                process.kill()
        self.pool.shutdown()

    def render(self, jobs: list[dict]) -> Iterator[dict]:
        """The messages of all children as they come (see `render_asset`; jobs without "cores"), and once for each job,
        its last, {"end": its number, …} with what `render_job` returns."""
        for number, job in enumerate(jobs):
            self.pool.submit(self._render, number, job)
        unfinished = len(jobs)
        while unfinished:
            message = self.messages.get()
            if "raised" in message:
                raise message["raised"]
            unfinished -= "end" in message
            yield message

    def _render(self, number: int, job: dict) -> None:
        own_cores = self.free_cores.get()
        try:
            became = render_job(job | {"cores": own_cores}, self.messages.put, self.running, self.limits)
        except BaseException as e:  # else `render` would wait for it for ever
            self.messages.put({"raised": e})
            raise
        self.free_cores.put(own_cores)
        self.messages.put({"end": number, **became})


def cores() -> list[int]:
    """The processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))
