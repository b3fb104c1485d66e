# SPDX-License-Identifier: GPL-3.0-or-later
"""Checkpoints that are whole, or refused in one sentence."""

import json

import pytest
import torch
from safetensors.torch import load_file, save_file

from timesplat.datagen.sequence import InputError
from timesplat.model import baselines  # noqa: F401, adds its methods
from timesplat.model.checkpoints_io import CHECKPOINTS, load_network
from timesplat.model.methods import METHODS
from timesplat.model.network import Config, Network

TINY = Config(width=32, depth=1, heads=2, source="given")


def test_checkpoint_round_trip(checkpoint):
    torch.manual_seed(0)
    network, back = Network(TINY), load_network(checkpoint)
    assert back.config == TINY and not back.training
    for k, v in network.state_dict().items():
        torch.testing.assert_close(back.state_dict()[k], v.half().float(), rtol=0, atol=0)
    assert not list(checkpoint.parent.glob("*.tmp"))


@pytest.mark.parametrize("keep", [0, 7, 100, 0.5, 0.999])
def test_truncated_checkpoint_is_one_sentence(checkpoint, keep):
    data = checkpoint.read_bytes()
    checkpoint.write_bytes(data[: int(keep * len(data)) if isinstance(keep, float) else keep])
    with pytest.raises(InputError, match=r"tiny\.safetensors: not a whole Timesplat checkpoint"):
        load_network(checkpoint)


def test_checkpoint_with_nan_or_another_shape_or_no_config(checkpoint, tmp_path):
    tensors = load_file(checkpoint)
    meta = {"config": json.dumps({"width": 32, "depth": 1, "heads": 2, "source": "given"})}
    bad = dict(tensors)
    bad["embed.weight"] = torch.full_like(bad["embed.weight"], float("nan"))
    save_file(bad, tmp_path / "nan.safetensors", meta)
    with pytest.raises(InputError, match=r"embed\.weight hold NaN"):
        load_network(tmp_path / "nan.safetensors")
    save_file(tensors, tmp_path / "wide.safetensors", {"config": json.dumps({"width": 64, "depth": 1, "heads": 2})})
    with pytest.raises(InputError, match="not a whole Timesplat checkpoint"):
        load_network(tmp_path / "wide.safetensors")
    save_file(tensors, tmp_path / "bare.safetensors")
    with pytest.raises(InputError, match="not a whole Timesplat checkpoint"):
        load_network(tmp_path / "bare.safetensors")
    meta = {"config": json.dumps({"width": 32, "depth": 1, "heads": 2, "source": "given", "head": "kinematik"})}
    save_file(tensors, tmp_path / "typo.safetensors", meta)
    with pytest.raises(InputError, match=r"typo\.saf.*: not a whole Timesplat .*\(head kinematik: .*kinematic\); copy"):
        load_network(tmp_path / "typo.safetensors")
    with pytest.raises(InputError, match="no such checkpoint"):
        load_network(tmp_path / "none.safetensors")


def test_what_methods_load_is_shipped():
    assert {m.checkpoint for m in METHODS.values()} <= {None, *(f.stem for f in CHECKPOINTS.glob("*.safetensors"))}
