# SPDX-License-Identifier: GPL-3.0-or-later
"""Several processes that train one network: `torchrun --nproc-per-node 2 -m timesplat.cli train …`. N of them do what
one does with N times `--accumulate`; without torchrun all of this does nothing.
"""

from __future__ import annotations

import os
from datetime import timedelta

import torch
import torch.distributed as dist


def start(device: str) -> str:
    """Joins the processes that torchrun started, by gloo between CPUs and NCCL between GPUs; returns the device that
    this one is to use."""
    if "WORLD_SIZE" not in os.environ or dist.is_initialized():
        return device
    if device.startswith("cuda"):
        device = f"cuda:{os.environ['LOCAL_RANK']}"
        torch.cuda.set_device(device)
    timeout = timedelta(hours=12)  # while the first packs the clips
    dist.init_process_group("nccl" if device.startswith("cuda") else "gloo", timeout=timeout)
    return device


def end() -> None:
    """Leaves the other processes."""
    if dist.is_initialized():
        dist.destroy_process_group()


def rank() -> int:
    """Number of this process among all, from 0; the first packs, reports and saves."""
    return dist.get_rank() if dist.is_initialized() else 0


def world_size() -> int:
    """How many processes train."""
    return dist.get_world_size() if dist.is_initialized() else 1


def barrier() -> None:
    """Waits until all processes are here."""
    if dist.is_initialized():
        dist.barrier()


def average_gradients(network: torch.nn.Module) -> None:
    """Makes every gradient its mean over the processes, in one message; a parameter without one counts as zero."""
    if world_size() == 1:
        return
    parameters = list(network.parameters())
    flat = torch.cat([(torch.zeros_like(p) if p.grad is None else p.grad).flatten() for p in parameters])
    dist.all_reduce(flat)
    for p, g in zip(parameters, (flat / world_size()).split([p.numel() for p in parameters]), strict=True):
        p.grad = g.view_as(p)


def reduce_max(values: list[float], device: str) -> list[float]:
    """Of each number the greatest of all processes, so that they agree on time and on stopping."""
    if world_size() == 1:
        return values
    reduced = torch.tensor(values, dtype=torch.float64, device=device)
    dist.all_reduce(reduced, dist.ReduceOp.MAX)
    return reduced.tolist()
