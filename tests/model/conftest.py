# SPDX-License-Identifier: GPL-3.0-or-later
"""What the tests of several rooms of the model start from."""

import pytest
import torch

from timesplat.model.checkpoints_io import save_network
from timesplat.model.network import Config, Network


@pytest.fixture
def checkpoint(tmp_path):
    """A checkpoint of the smallest guided network, of random weights."""
    torch.manual_seed(0)
    path = tmp_path / "tiny.safetensors"
    save_network(path, Network(Config(width=32, depth=1, heads=2, source="given")), {"steps": "0"})
    return path
