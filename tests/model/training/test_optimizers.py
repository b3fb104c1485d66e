"""Steps: the schedule, what is skipped, and which optimizer takes what."""

import math

import pytest
import torch

from timesplat.model.network import Config, Network
from timesplat.model.training.optimizers import clip_and_step, learning_rate, make_optimizers, weights_fit_checkpoint


@pytest.mark.parametrize("size,warmed_up,steps", [(1e3, True, False), (1e3, False, True), (float("nan"), False, False)])
def test_a_wild_gradient_changes_nothing(size, warmed_up, steps):
    network = torch.nn.Linear(2, 2)
    network.blocks = torch.nn.ModuleList()
    optimizers = make_optimizers(network, "adamw")
    before = network.weight.clone()
    network.weight.grad = torch.full((2, 2), size)
    assert clip_and_step(optimizers, 0.1, warmed_up) == steps
    assert torch.equal(network.weight, before) != steps and network.weight.grad is None


def test_the_rate_warms_up_and_falls_to_zero():
    assert learning_rate(1.0, 0, 100, 0.0) == pytest.approx(0.01)
    assert learning_rate(1.0, 99, 100, 0.0) == pytest.approx(1)
    assert learning_rate(1.0, 500, 100, 0.5) == pytest.approx(0.5)
    assert learning_rate(1.0, 999, 100, 1.0) == pytest.approx(0)


def test_muon_takes_the_matrices_of_the_blocks():
    """Orthogonal steps for them, of about AdamW's size; everything else is AdamW's."""
    network = Network(Config(width=32, depth=2, heads=2))
    adamw, muon = make_optimizers(network, "muon")
    (group,) = muon.param_groups
    assert {p.data_ptr() for p in group["params"]} == {
        p.data_ptr() for n, p in network.named_parameters() if n.startswith("blocks") and p.ndim == 2
    }
    assert sum(len(g["params"]) for g in [*adamw.param_groups, group]) == len(list(network.parameters()))
    p = network.blocks[0].qkv.weight
    before = p.detach().clone()
    for q in network.parameters():
        q.grad = torch.randn_like(q)
    assert clip_and_step([adamw, muon], 0.01, warmed_up=False)
    step = (p.detach() - before) / 0.01
    assert float(step.square().mean().sqrt()) == pytest.approx(0.2, rel=0.3)
    values = torch.linalg.svdvals(step)
    assert values.max() / values.min() < 4


@pytest.mark.parametrize(("weight", "fits"), [(0.0, True), (65504.0, True), (65520.0, False), (math.nan, False)])
def test_weights_that_half_precision_cannot_hold_are_seen(weight, fits):
    network = torch.nn.Linear(2, 2)
    network.weight.data[0, 1] = weight
    assert weights_fit_checkpoint(network) == fits
