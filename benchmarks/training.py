# SPDX-License-Identifier: GPL-3.0-or-later
"""How fast training is, and what its time goes into: `python benchmarks/training.py data/zoo`.

A Markdown table with a row for each preset and source: steps of one sample a second by the clock, processor seconds
a step (under load only these compare), and the share of data, geometry (lift or sweep), network and rasteriser.

The floor, counted: a network of M parameters in matrices, L blocks of width D and T tokens takes 2·M·T + 4·L·D·T²
floating-point operations forward (every token meets every matrix; queries meet keys, and weights meet values), and
twice that backward; with `--checkpointing` a forward pass more. The table says how many those are, in how many
milliseconds this machine multiplies 2048² matrices with as many of them in the same precision, and how many times
longer the network's share took.
"""

from __future__ import annotations

import argparse
import time
from tempfile import TemporaryDirectory

import numpy as np
import torch

from timesplat.model.network import Network
from timesplat.model.training.config import TrainConfig, add_arguments
from timesplat.model.training.reporting import STAGES
from timesplat.model.training.trainer import Trainer, load_clips, make_network

HEADER = ("network", "weights", "tokens", "steps/s", "CPU-s a step", *STAGES, "GFLOP", "floor, ms", "network is")


def machine_rate(device: str, dtype: torch.dtype, size: int = 2048) -> float:
    """Floating-point operations a second of a matrix product, the best of five."""
    a = torch.randn(size, size, device=device, dtype=dtype)
    best = float("inf")
    for _ in range(5):
        start = time.perf_counter()
        (a @ a)[0, 0].item()  # waits for the device
        best = min(best, time.perf_counter() - start)
    return 2 * size**3 / best


def step_flops(network: Network, tokens: float, checkpointing: bool) -> float:
    c = network.config
    matrices = sum(p.numel() for p in network.parameters() if p.ndim == 2)
    blocks = sum(p.numel() for p in network.blocks.parameters() if p.ndim == 2)
    attention = 4 * c.depth * c.width * tokens**2
    again = 2 * blocks * tokens + attention if checkpointing else 0
    return 3 * (2 * matrices * tokens + attention) + again


def measure(config: TrainConfig, steps: int) -> list[str]:
    """A row of the table; the first step, which compiles, is left out."""
    network = make_network(config).to(config.device)
    trainer = Trainer(network, load_clips(config), config)
    tokens: list[int] = []
    network.blocks[0].register_forward_pre_hook(lambda module, inputs: tokens.append(len(inputs[0])))
    trainer.train_step()
    tokens.clear()
    trainer.timer.reset()
    wall, cpu = time.perf_counter(), time.process_time()
    for _ in range(steps):
        trainer.train_step()
    wall, cpu = (time.perf_counter() - wall) / steps, (time.process_time() - cpu) / steps
    flops = step_flops(network, float(np.sqrt(np.mean(np.square(tokens)))), config.checkpointing)
    floor = flops / machine_rate(config.device, torch.bfloat16 if config.bf16 else torch.float32)
    taken = trainer.timer.seconds["network"] / steps
    weights = sum(p.numel() for p in network.parameters())
    return [
        f"{config.preset}, {config.source}, {config.device}" + (", bf16" if config.bf16 else ""),
        f"{weights / 1e6:.1f} M",
        f"{np.mean(tokens):.0f}",
        f"{1 / wall:.2f}",
        f"{cpu:.2f}",
        *(f"{x:.0%}" for x in trainer.timer.fractions.values()),
        f"{flops / 1e9:.0f}",
        f"{1000 * floor:.0f}",
        f"{taken / floor:.1f} times that",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0], epilog="Options of `timesplat train` follow.")
    parser.add_argument("data", nargs="+", help="folders of Sequences rendered with passes")
    parser.add_argument("--presets", default="tiny,small", help="comma-separated (default: tiny,small)")
    parser.add_argument("--sources", default="given,sweep,predicted", help="comma-separated (default: all three)")
    parser.add_argument("--steps", type=int, default=10, help="to measure (default: 10)")
    args, more = parser.parse_known_args()
    train = argparse.ArgumentParser()
    add_arguments(train)
    print(f"{torch.get_num_threads()} threads, torch {torch.__version__}\n")
    print("|", " | ".join(HEADER), "|\n" + "|---" * len(HEADER) + "|")
    for preset in args.presets.split(","):
        for source in args.sources.split(","):
            with TemporaryDirectory() as out:
                words = [*args.data, "--out", out, "--preset", preset, "--source", source, "--head", "kinematic", *more]
                row = measure(TrainConfig.from_arguments(train.parse_args(words)), args.steps)
            print("|", " | ".join(row), "|", flush=True)


if __name__ == "__main__":
    main()
