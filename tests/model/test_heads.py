# SPDX-License-Identifier: GPL-3.0-or-later
"""Outputs to Gaussians: their order is the checkpoints', and what outputs of zero and of any size become."""

import pytest
import torch

from timesplat.model.heads import (
    ABSOLUTE,
    KINEMATIC,
    PAPER,
    RESIDUAL,
    STILL,
    activate,
    along_rays,
    corrected,
    in_the_box,
)


def outputs(layout, n=50, size=0.0):
    return layout.split(size * torch.randn(n, layout.width, generator=torch.Generator().manual_seed(0)))


def names(layout):
    return [k for k, n in layout.widths.items() for _ in range(n)]


def test_the_order_is_that_of_the_checkpoints():
    start = [*["xyz"] * 3, "t", *["rgb"] * 3, *["scale"] * 3, "scale_t"]
    assert names(PAPER) == [*start, *["q_l"] * 4, *["q_r"] * 4, "opacity"]
    assert names(KINEMATIC) == [*start, *["rotation"] * 4, *["velocity"] * 3, "opacity"]
    assert names(STILL) == [*["xyz"] * 3, *["rgb"] * 3, *["scale"] * 3, *["rotation"] * 4, "opacity"]
    for head, absolute in ABSOLUTE.items():
        assert RESIDUAL[head].width == absolute.width
        for name in ("xyz", "t", "rgb", "scale", "scale_t", "opacity"):
            assert RESIDUAL[head].slice(name) == absolute.slice(name)
        assert RESIDUAL[head].slice("velocity") == KINEMATIC.slice("velocity")


@pytest.mark.parametrize("layout", [KINEMATIC, STILL])
def test_outputs_of_zero_are_the_appendix_biases(layout):
    g = activate(outputs(layout))
    assert (g.rgb == 0.5).all() and not g.velocity.any() and (g.rotation == torch.tensor([1.0, 0, 0, 0])).all()
    torch.testing.assert_close(g.scale, torch.full_like(g.scale, 0.100259), atol=1e-6, rtol=0)
    torch.testing.assert_close(g.opacity, torch.full_like(g.opacity, 0.119203), atol=1e-6, rtol=0)
    assert (g.sigma_t == 1e6).all() if layout is STILL else (g.sigma_t - 0.100259).abs().max() < 1e-6


@pytest.mark.parametrize("layout", [PAPER, KINEMATIC, STILL])
def test_any_outputs_are_gaussians(layout):
    g = activate(outputs(layout, size=5.0))
    assert g.xyz.shape == g.velocity.shape == (50, 3) and g.t.shape == g.sigma_t.shape == g.opacity.shape == (50,)
    assert torch.linalg.eigvalsh(g.covariance3().double()).min() > -1e-7  # round-off of sides up to 0.3
    if g.cov3 is None:
        assert g.scale.max() <= 0.3
        torch.testing.assert_close(g.rotation.norm(dim=-1), torch.ones(50))


def test_distances_along_rays_stay_in_range():
    origin = torch.tensor([2.7, 0.1, 0.0]).expand(50, 3)
    direction = torch.tensor([-1.0, 0, 0]).expand(50, 3)
    paper, centred = (along_rays(outputs(KINEMATIC, size=50.0), origin, direction, k).xyz for k in ("paper", "centred"))
    assert (paper[:, 1:] == origin[:, 1:]).all() and (centred[:, 1:] == origin[:, 1:]).all()
    distance = 2.7 - paper[:, 0]
    assert distance.min() >= 0.0999 and distance.max() <= 4.5001 and distance.std() > 1
    assert centred[:, 0].abs().max() <= 1.8001


def test_free_gaussians_are_in_the_box_and_the_clip():
    g = in_the_box(outputs(PAPER, size=50.0))
    assert g.xyz.abs().max() <= 1 and g.t.abs().max() <= 1


@pytest.mark.parametrize("head", ["paper", "kinematic"])
def test_corrections_are_bounded_and_none_are_none(head):
    base = activate(outputs(KINEMATIC, size=1.0))
    direction = torch.nn.functional.normalize(torch.ones(50, 3), dim=-1)
    max_shift = torch.full((50,), 0.02)
    same = corrected(outputs(RESIDUAL[head]), base, direction, max_shift)
    for k in ("xyz", "t", "velocity", "sigma_t", "scale", "rotation", "rgb", "opacity"):
        torch.testing.assert_close(getattr(same, k), getattr(base, k), rtol=0, atol=1e-5)
    g = corrected(outputs(RESIDUAL[head], size=100.0), base, direction, max_shift)
    assert (g.xyz - base.xyz).norm(dim=-1).max() <= 0.0201
    assert (g.t - base.t).abs().max() <= 0.3001 and (g.velocity - base.velocity).abs().max() <= 4.001
    assert (g.scale / base.scale).log().abs().max() <= 1.501 and (g.rgb - base.rgb).abs().max() <= 0.501
    torch.testing.assert_close(g.rotation.norm(dim=-1), torch.ones(50))


def test_unused_outputs_change_nothing():
    base = activate(outputs(KINEMATIC, size=1.0))
    for layout in RESIDUAL.values():
        some = outputs(layout, size=1.0)
        other = {k: x + 9 if k.startswith("unused") else x for k, x in some.items()}
        a, b = (corrected(x, base, torch.ones(50, 3), torch.ones(50)) for x in (some, other))
        assert torch.equal(a.rotation, b.rotation) and torch.equal(a.velocity, b.velocity)
