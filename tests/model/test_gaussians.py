# SPDX-License-Identifier: GPL-3.0-or-later
"""The two forms of a 4D Gaussian are one: closed forms against float64 linear algebra."""

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn.functional import normalize

from timesplat.model.gaussians import Gaussians4D, kinematic_from_covariance, paper_from_kinematic
from timesplat.model.io.asset import Clip
from timesplat.model.rotations import isoclinic_rotation


def cloud(n: int, seed: int = 0, dtype=torch.float64) -> Gaussians4D:
    r = torch.Generator().manual_seed(seed)

    def rand(*shape):
        return torch.rand(shape, generator=r, dtype=dtype)

    return Gaussians4D(
        xyz=rand(n, 3) * 2 - 1,
        t=rand(n) * 2 - 1,
        velocity=rand(n, 3) * 4 - 2,
        sigma_t=rand(n) * 0.5 + 0.01,
        scale=rand(n, 3) * 0.2 + 0.003,
        rotation=normalize(rand(n, 4) - 0.5, dim=-1),
        rgb=rand(n, 3),
        opacity=rand(n),
    )


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_kinematic_form_survives_the_covariance(seed):
    g = cloud(4, seed)
    velocity, sigma_t, cov3 = kinematic_from_covariance(g.covariance4())
    torch.testing.assert_close(velocity, g.velocity)
    torch.testing.assert_close(sigma_t, g.sigma_t)
    torch.testing.assert_close(cov3, g.covariance3(), rtol=1e-9, atol=1e-12)


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_slice_is_the_papers_conditional(seed):
    """Equation 2 of the paper, by its own block formula."""
    g, t = cloud(4, seed), 0.3
    S = g.covariance4()
    mean = g.xyz + S[:, :3, 3] / S[:, 3, 3, None] * (t - g.t)[:, None]
    cov = S[:, :3, :3] - S[:, :3, 3:] @ S[:, 3:, :3] / S[:, 3, 3, None, None]
    torch.testing.assert_close(g.position(torch.tensor(t)), mean)
    torch.testing.assert_close(g.covariance3(), cov, rtol=1e-9, atol=1e-12)


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_paper_form_and_back(seed):
    g = cloud(4, seed)
    scale, q_l, q_r = paper_from_kinematic(g)
    R = isoclinic_rotation(q_l, q_r)
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(4, dtype=R.dtype))
    torch.testing.assert_close((R * scale[:, None, :] ** 2) @ R.mT, g.covariance4(), rtol=1e-8, atol=1e-11)


def test_axes_are_derived_where_they_are_needed_and_not_before(monkeypatch):
    g = cloud(20)
    known = Gaussians4D.from_covariance(g.xyz, g.t, g.velocity, g.sigma_t, g.covariance3(), g.rgb, g.opacity)
    monkeypatch.setattr(torch.linalg, "eigh", None)  # fails where it is called
    back = known.with_axes()
    assert back.cov3 is None and known.cov3 is not None
    torch.testing.assert_close(back.covariance3(), g.covariance3())
    of_file = Gaussians4D.from_asset(known.to_asset(Clip()))
    torch.testing.assert_close(of_file.covariance3(), g.covariance3().float(), rtol=1e-4, atol=1e-9)


def test_asset_round_trip_and_cat():
    g = cloud(5, dtype=torch.float32)
    back = Gaussians4D.from_asset(g.to_asset(Clip()))
    for k in ("xyz", "t", "velocity", "sigma_t", "scale", "rotation", "rgb", "opacity"):
        torch.testing.assert_close(getattr(back, k), getattr(g, k), rtol=0, atol=0)
    both = Gaussians4D.cat([g, g[:2]])
    assert len(both) == 7 and both.cov3 is None


def test_alive_is_the_papers_filter_at_its_best_moment():
    g = cloud(4, dtype=torch.float32)
    g.opacity = torch.tensor([0.9, 0.04, 0.9, 0.9])
    g.t = torch.tensor([0.0, 0.0, 1.5, 1.05])  # the third is over before the clip's end can see it
    g.sigma_t = torch.tensor([0.1, 0.1, 0.1, 0.1])
    assert g.alive().tolist() == [True, False, False, True]


def test_a_frozen_scene_is_the_slice_at_its_moment_for_ever():
    g, moment = cloud(40), torch.tensor(0.3)
    still = g.frozen(0.3)
    for t in (-1.0, 0.3, 0.9):
        torch.testing.assert_close(still.position(torch.tensor(t)), g.position(moment))
        torch.testing.assert_close(still.opacity * still.marginal(torch.tensor(t)), g.opacity * g.marginal(moment))


def test_widened_adds_the_same_to_every_direction():
    torch.manual_seed(0)
    rotation = torch.nn.functional.normalize(torch.randn(5, 4), dim=-1)
    zero, one = torch.zeros(5), torch.ones(5)
    g = Gaussians4D(torch.zeros(5, 3), zero, torch.zeros(5, 3), one, torch.rand(5, 3), rotation, torch.zeros(5, 3), one)
    expected = g.covariance3() + 0.2**2 * torch.eye(3)
    known = Gaussians4D.from_covariance(g.xyz, g.t, g.velocity, g.sigma_t, g.covariance3(), g.rgb, g.opacity)
    for wide in (g.widened(0.2), known.widened(0.2), known.widened(0.2).with_axes()):
        torch.testing.assert_close(wide.covariance3(), expected, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(known.widened(0.2).scale, expected.diagonal(dim1=-2, dim2=-1).sqrt())
    assert known.cov3 is not None and torch.equal(known.cov3, g.covariance3())
