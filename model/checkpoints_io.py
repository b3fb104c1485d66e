# SPDX-License-Identifier: GPL-3.0-or-later
"""Checkpoints: a network's weights and its config in one .safetensors, and the folder of those that are shipped."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import torch

from ..datagen.sequence import InputError
from .devices import check_device

CHECKPOINTS = Path(__file__).parent / "checkpoints"


def save_network(path: Path, network, extra: dict[str, str] | None = None) -> None:
    """Weights in half precision with the config (and `extra` strings) inside, written whole or not at all."""
    from safetensors.torch import save_file

    path = Path(path)
    tensors = {k: v.detach().half().contiguous() for k, v in network.state_dict().items()}
    tmp = path.with_name(path.name + ".tmp")
    save_file(tensors, tmp, {"config": json.dumps(asdict(network.config)), **(extra or {})})
    tmp.replace(path)


def load_network(path: Path, device: str = "cpu"):
    """A network in evaluation mode from a .safetensors with its config inside. Raises InputError for a file that is
    not there, not whole or not finite, and for a device that cannot be used."""
    from safetensors import safe_open

    from .network import Config, Network

    check_device(device)
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such checkpoint; train one with `timesplat train`, or name another.")
    try:
        with safe_open(path, "pt") as f:
            config = Config(**json.loads(f.metadata()["config"]))
            tensors = {k: f.get_tensor(k).float() for k in f.keys()}  # noqa: SIM118
        network = Network(config)
        network.load_state_dict(tensors, assign=True)
    except Exception as e:
        reason = str(e).rstrip(".")
        raise InputError(f"{path}: not a whole Timesplat checkpoint ({reason}); copy or train it again.") from None
    bad = [k for k, v in tensors.items() if not torch.isfinite(v).all()]
    if bad:
        raise InputError(f"{path}: the weights {bad[0]} hold NaN or infinity; copy or train it again.")
    return network.to(device).eval()
