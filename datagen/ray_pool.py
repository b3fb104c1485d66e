# SPDX-License-Identifier: GPL-3.0-or-later
"""Jobs to the machines of a Ray cluster, one core each: `timesplat render --ray`. All else is as in `render_pool`.

Every machine has Timesplat installed, and sees the assets and the run's folder under the same paths. A worker that is
killed takes its child along; Ray hands the job out again, and the Sequences that were whole stay.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path

from .errors import InputError
from .render_child import Limits, remove_half_written, render_job
from .render_index import CRASHED
from .render_pool import cores

LOCAL = "local"  # Ray's own word for a cluster of this machine, which is started and ended with the run
RETRIES = 10  # of a job whose worker was killed: on machines that may be taken away that is no fault of the asset
_AHEAD = 1000  # jobs that Ray knows of, from which it sees how many machines it needs


class RayPool:
    """As a context: it is connected to the cluster at `address`, or for LOCAL starts one of `jobs` cores."""

    def __init__(self, address: str, jobs: int, limits: Limits) -> None:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is reported to anybody
        os.environ.setdefault("RAY_worker_niceness", "0")  # as without Ray, and not behind all that the machine does
        import ray

        if address != LOCAL and Path(address).exists():
            raise InputError(f"--ray {address}: a file, no address; write --ray behind the assets, or --ray=local.")
        here = {"num_cpus": jobs, "include_dashboard": False, "object_store_memory": 10**8} if address == LOCAL else {}
        try:
            ray.init(address, log_to_driver=False, logging_level="ERROR", **here)
        except (OSError, ValueError, RuntimeError, ray.exceptions.RayError) as e:
            first = (str(e).strip().splitlines() or [type(e).__name__])[0]
            raise InputError(
                f"--ray {address}: no cluster answers there ({first}); start one by `ray start`."
            ) from None
        self.ray, self.limits = ray, limits

    def __enter__(self) -> RayPool:
        return self

    def __exit__(self, kind, error, traceback) -> None:
        self.ray.shutdown()

    def render(self, jobs: list[dict]) -> Iterator[dict]:
        """As that of `render_pool.LocalPool`, but that a job's messages come when it has ended."""
        task = self.ray.remote(num_cpus=1, max_retries=RETRIES)(_render)
        rest = iter(enumerate(jobs))
        waiting: dict = {}  # what Ray promised -> number of the job
        while True:
            for number, job in islice(rest, _AHEAD - len(waiting)):
                waiting[task.remote(job, self.limits)] = number
            if not waiting:
                return
            (done,), _ = self.ray.wait(list(waiting), num_returns=1)
            number = waiting.pop(done)
            try:
                messages, became = self.ray.get(done)
            except self.ray.exceptions.RayError as e:
                messages, became = [], _given_up(jobs[number]["asset"]["path"], e)
            yield from messages
            yield {"end": number, **became}


def _render(job: dict, limits: Limits) -> tuple[list[dict], dict]:
    """On a worker: the messages of a job, and what became of it."""
    remove_half_written(job)  # by a worker that was killed
    messages: list[dict] = []
    with _own_core() as own:
        became = render_job(job | {"cores": own}, messages.append, set(), limits)
    return messages, became


@contextmanager
def _own_core() -> Iterator[list[int]]:
    """A core of this machine that no other worker has, for Ray counts them and does not say which; [] (as many as it
    likes) where all are taken or the system has no locks of files. The system frees it when the worker is killed."""
    try:
        import fcntl
    except ImportError:
        yield []
        return
    for core in cores():
        with open(Path(tempfile.gettempdir()) / f"timesplat-core-{os.getuid()}-{core}.lock", "a") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                continue
            yield [core]
            return
    yield []


def _given_up(path: str, error: Exception) -> dict:
    """What became of a job that Ray gave up."""
    sentence = (
        f"{path}: Ray gave it up ({type(error).__name__}), for {RETRIES + 1} workers were killed over it; see whether "
        "their machines have memory enough, set --limit-memory, and start again with --retry."
    )
    return {"written": [], "error": {"error": sentence, "status": CRASHED}, "seconds": 0.0, "cpu_seconds": 0.0}
