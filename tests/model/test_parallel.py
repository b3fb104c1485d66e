# SPDX-License-Identifier: GPL-3.0-or-later
"""Jobs on threads: all are done, once, in order, and faults come out; and the clock goes forward."""

import threading

import pytest
import torch

from timesplat.model.parallel import chunks, parallel_for, work_clock


@pytest.fixture(params=[1, 3])
def threads(request):
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


def test_results_come_in_the_order_of_the_jobs(threads):
    assert parallel_for([(i, i + 1) for i in range(40)], lambda a, b: a * b) == [i * (i + 1) for i in range(40)]
    assert parallel_for([], lambda: 1) == []


def test_as_many_threads_work_at_once_as_torch_uses(threads):
    meet = threading.Barrier(threads, timeout=20)
    assert parallel_for([(i,) for i in range(threads)], lambda i: meet.wait() >= 0) == [True] * threads


def test_what_a_job_raises_comes_out(threads):
    def work(i):
        if i == 5:
            raise RuntimeError("five")

    with pytest.raises(RuntimeError, match="five"):
        parallel_for([(i,) for i in range(9)], work)


@pytest.mark.parametrize(("count", "size"), [(0, 4), (1, 4), (4, 4), (9, 4)])
def test_chunks_cover_all_once(count, size):
    found = chunks(count, size)
    assert [i for a, b in found for i in range(a, b)] == list(range(count))
    assert all(0 < b - a <= size for a, b in found)


def test_the_clock_goes_forward(threads):
    assert work_clock() <= work_clock()
