# SPDX-License-Identifier: GPL-3.0-or-later
"""Parameters: Adam as torch has it, rows that come and go; raw tensors and back."""

import pytest
import torch

from timesplat.model.fitting.parameters import BETAS, EPSILON, RATES, Parameters, activate, raw_parameters
from timesplat.model.gaussians import FIELDS
from timesplat.model.geometry.lift import lift


def test_adam_is_torchs_and_rates_decay():
    torch.manual_seed(0)
    start, goal = torch.randn(5, 3), torch.randn(5, 3)
    p = Parameters({"a": start, "fixed": start}, {"a": (0.1, 0.001), "fixed": (0.0, 0.0)})
    theirs = torch.nn.Parameter(start.clone())
    adam = torch.optim.Adam([theirs], betas=BETAS, eps=EPSILON)
    for i in range(10):
        adam.param_groups[0]["lr"] = 0.1 * 0.01 ** (i / 10)
        for x in (theirs, p["a"]):
            ((x - goal) ** 2).sum().backward()
        adam.step()
        adam.zero_grad()
        p.step(i / 10)
    torch.testing.assert_close(p["a"], theirs, atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(p["fixed"].detach(), start, rtol=0, atol=0)


@pytest.mark.parametrize("steps,last", [(0, 0.01), (1000, 0.01), (4000, 0.0025)])
def test_in_a_long_fit_what_settles_does(steps, last):
    p = Parameters({"a": torch.zeros(1), "b": torch.zeros(1)}, {"a": (0.1, 0.01), "b": (0.1, 0.01)}, settling=["a"])
    (p["a"] + p["b"]).sum().backward()
    p.step(1.0, steps)
    assert p["a"].item() == pytest.approx(-last) and p["b"].item() == pytest.approx(-0.01)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_what_is_hardly_seen_moves_little(dtype):
    """The compiled step in float32, torch's operations in float64; by hand: 0.1 g / (|g| + r), r the gradients' rms."""
    p = Parameters({"a": torch.zeros(2, dtype=dtype)}, {"a": (0.1, 0.1)}, seldom=1.0)
    g = torch.tensor([1.0, 1e-3], dtype=dtype)
    (p["a"] * g).sum().backward()
    p.step(0.0)
    r = g.square().mean().sqrt()
    torch.testing.assert_close(p["a"].detach(), -0.1 * g / (g + r), rtol=1e-4, atol=1e-9)


def test_rows_take_their_moments_along_and_nan_moves_nothing():
    p = Parameters({"a": torch.zeros(4), "b": torch.zeros(4, 2)}, {"a": (1.0, 1.0), "b": (1.0, 1.0)})
    (p["a"] * torch.arange(4.0)).sum().backward()
    p.keep_rows(torch.tensor([3, 3, 1]))
    assert p["a"].grad.tolist() == [3, 3, 1] and p["b"].shape == (3, 2) and p["b"].grad is None
    p["a"].grad[2] = torch.nan
    p.step(0.0)
    assert p["a"].tolist() == pytest.approx([-1, -1, 0], abs=1e-6) and p["a"].requires_grad
    p.reset_moments(torch.tensor([0]))
    assert p.moments["a"][0][0] == 0 and p.moments["a"][0][1] != 0
    (p["a"] * torch.arange(3.0)).sum().backward()
    p.add_rows({"a": torch.tensor([7.0]), "b": torch.ones(1, 2)})
    assert p["a"].grad.tolist() == [0, 1, 2, 0] and p["b"].grad is None and p["b"][3].tolist() == [1, 1]
    assert p["a"][3] == 7 and p["a"].requires_grad and p.moments["a"][1][1] != 0 and p.moments["a"][1][3] == 0


def test_raw_parameters_activate_to_the_same_gaussians(spheres):
    g = lift(spheres([0, 8], size=32)).with_axes()
    back = activate(raw_parameters(g))
    assert list(RATES) == FIELDS
    for k in FIELDS:
        expected = g.opacity.clamp(0.01, 0.99) if k == "opacity" else getattr(g, k)
        torch.testing.assert_close(getattr(back, k), expected, atol=1e-5, rtol=1e-4)
    longer = activate(raw_parameters(g, min_sigma_t=0.5, fade=0.3))
    assert longer.sigma_t.min() > 0.499 and longer.opacity.max() < 0.31


def test_what_is_common_keeps_its_rows_and_moments():
    p = Parameters({"a": torch.zeros(4), "all": torch.ones(2, 3)}, {"a": (1.0, 1.0), "all": (1.0, 1.0)}, common=["all"])
    (p["a"].sum() + p["all"].sum()).backward()
    p.step(0.0)
    p.keep_rows(torch.tensor([3, 3, 1, 0, 2]))
    p.reset_moments(torch.tensor([4]))
    assert len(p["a"]) == 5 and p["all"].shape == (2, 3)
    assert p.moments["a"][0][4] == 0 and (p.moments["all"][0] > 0).all()


def test_what_is_replaced_begins_anew():
    p = Parameters({"a": torch.zeros(3, 2), "b": torch.zeros(4)}, {"a": (0.1, 0.1), "b": (0.1, 0.1)}, common=["b"])
    (p["a"].sum() + p["b"].sum()).backward()
    p.step(0.0)
    p.replace("b", torch.ones(5, 2))
    assert p["b"].shape == (5, 2) and p["b"].grad is None and all(float(m.abs().max()) == 0 for m in p.moments["b"])
    p["b"].sum().backward()
    p.step(0.0)
    assert float(p["b"].max()) < 1 and torch.equal(p["a"], torch.full((3, 2), -0.1))
