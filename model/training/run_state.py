# SPDX-License-Identifier: GPL-3.0-or-later
"""What changes during a training run, and its file, from which the run goes on exactly."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from ...datagen.sequence import InputError
from ..network import Network
from .optimizers import make_optimizers, weights_fit_checkpoint

AVERAGE_DECAY = 0.998  # per step, of the average of the weights; it is what networks are shipped with

_PROGRESS = {  # key in the file -> field
    "step": "step",
    "seconds": "seconds",
    "cpu": "cpu_seconds",
    "skipped": "skipped_steps",
    "bad": "nonfinite_samples",
}


@dataclass
class RunState:
    """A network in training, the moving average of its weights, its optimizers, and how far it has come."""

    network: Network
    average: dict[str, Tensor]  # as the network's state dict
    optimizers: list[torch.optim.Optimizer]
    step: int = 0
    seconds: float = 0.0  # by the clock
    cpu_seconds: float = 0.0  # of this process
    skipped_steps: int = 0  # whose gradient was too long, or not finite
    nonfinite_samples: int = 0  # whose loss was not finite

    @classmethod
    def begin(cls, network: Network, optimizer: str) -> RunState:
        """At step 0. optimizer: see `make_optimizers`. Raises InputError."""
        average = {k: v.detach().clone() for k, v in network.state_dict().items()}
        return cls(network, average, make_optimizers(network, optimizer))

    def update_average(self) -> None:
        """Takes in the weights after `step` steps; of the first few they count more."""
        decay = min(AVERAGE_DECAY, self.step / (self.step + 10))
        for k, v in self.network.state_dict().items():
            self.average[k].lerp_(v, 1 - decay)

    def averaged_network(self) -> Network:
        """A copy of the network with the averaged weights, on the CPU."""
        network = Network(self.network.config)
        network.load_state_dict(self.average)
        return network

    def save(self, path: Path) -> None:
        """Writes the file whole or not at all."""
        state = {
            "network": self.network.state_dict(),
            "average": self.average,
            "optimisers": [o.state_dict() for o in self.optimizers],
            "progress": {k: getattr(self, name) for k, name in _PROGRESS.items()},
        }
        tmp = path.with_suffix(".tmp")
        torch.save(state, tmp)
        os.replace(tmp, path)

    def load(self, path: Path, device: str) -> None:
        """Goes on from a file of `save`, of the same network and optimizers. Raises InputError where it cannot."""
        try:
            state = torch.load(path, map_location=device, weights_only=True)
            self.network.load_state_dict(state["network"])
            if not weights_fit_checkpoint(self.network):
                raise ValueError("its weights are not finite")
            self.average = state["average"]
            for optimizer, saved in zip(self.optimizers, state["optimisers"], strict=True):
                optimizer.load_state_dict(saved)
            for k, name in _PROGRESS.items():
                setattr(self, name, state["progress"][k])
        except Exception as e:
            raise InputError(f"{path}: this run cannot be resumed ({e}); choose another --out.") from None
