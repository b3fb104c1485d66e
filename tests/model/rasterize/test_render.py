# SPDX-License-Identifier: GPL-3.0-or-later
"""`render`: what it draws, whoever draws it, and what it says of wrong arguments."""

import math
from dataclasses import replace

import pytest
import torch

from timesplat.model.rasterize import render

from .scenes import AXIS, FIELDS, cameras, cloud, gaussians, one_of, plane


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_single_gaussian_by_hand(backend):
    """On the axis at z = 2, isotropic: Σ₂ = (40 · 0.1 / 2)² + 0.1 = 4.1 px², alpha = o · m · exp(-½ d² / 4.1)."""
    colour = torch.tensor([0.9, 0.5, -0.3])
    g = replace(
        plane(1, 2.0),
        xyz=torch.tensor([[0.0, 0.0, 2.0]]),
        t=torch.tensor([0.5]),
        sigma_t=torch.tensor([0.5]),
        cov3=0.01 * torch.eye(3)[None],
        rgb=colour[None],
        opacity=torch.tensor([0.8]),
    )
    rgb, alpha = render(g, *AXIS, background=0.25, backend=backend)
    for x, y in ((20, 15), (22, 14), (17, 15)):
        d2 = (x + 0.5 - 20) ** 2 + (y + 0.5 - 15) ** 2
        a = 0.8 * math.exp(-0.5) * math.exp(-0.5 * d2 / 4.1)
        assert alpha[0, y, x].item() == pytest.approx(a, rel=1e-5)
        torch.testing.assert_close(rgb[0, y, x], a * colour + (1 - a) * 0.25, rtol=1e-5, atol=1e-6)
    assert alpha[0, 0, 0] == 0 and (rgb[0, 0, 0] == 0.25).all()


def test_background():
    g, view = cloud(100), cameras()
    black, alpha = render(g, *view, background=0.0)
    colour = torch.tensor([0.1, 0.7, 1.5])
    rgb, same = render(g, *view, background=colour)
    assert torch.equal(alpha, same)
    torch.testing.assert_close(rgb, black + (1 - alpha)[..., None] * colour)
    torch.testing.assert_close(render(g, *view)[0], black + (1 - alpha)[..., None])


def test_slice_is_the_conditional_of_the_4d_gaussian():
    """Rendering at τ equals rendering the static 3D Gaussians that the paper's conditional of Σ gives."""
    g, view = gaussians(), cameras()
    cov = g.covariance4().double()
    for i, tau in enumerate(view[2].tolist()):
        cross, var = cov[:, :3, 3], cov[:, 3, 3]
        static = replace(
            g,
            xyz=g.xyz + (cross * ((tau - g.t) / var)[:, None]).float(),
            t=tau * torch.ones_like(g.t),
            velocity=torch.zeros_like(g.velocity),
            sigma_t=torch.ones_like(g.t),
            cov3=(cov[:, :3, :3] - cross[:, :, None] * cross[:, None] / var[:, None, None]).float(),
            opacity=g.opacity * torch.exp(-0.5 * (tau - g.t) ** 2 / var).float(),
        )
        want, _ = render(static, *one_of(view, i))
        torch.testing.assert_close(render(g, *one_of(view, i))[0], want, rtol=1e-4, atol=2e-5)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_inference_filters_per_view(backend):
    g, view = gaussians(), cameras()
    got, _ = render(g, *view, inference=True, backend=backend)
    for i, tau in enumerate(view[2]):
        m = g.marginal(tau)
        keep = (m >= 0.05) & (m * g.opacity >= 0.05)
        assert 0 < keep.sum() < len(g)
        assert torch.equal(got[i], render(g[keep], *one_of(view, i), backend=backend)[0][0])
    assert not torch.equal(got, render(g, *view, backend=backend)[0])


def test_views_are_independent_and_dtype_is_kept():
    g, view = cloud(100), cameras()
    rgb, _ = render(g.to(torch.float64), *view)
    assert rgb.dtype == torch.float64
    for i in range(3):
        assert torch.equal(render(g, *one_of(view, i))[0][0], rgb[i].float())
    c2w, K, times, width, height = view
    none, alpha = render(g, c2w[:0], K[:0], times[:0], width, height)
    assert none.shape == (0, height, width, 3) and alpha.shape == (0, height, width)


def test_a_moving_scene_is_drawn_from_its_state_at_each_time():
    g = gaussians()

    class Slices:
        def at(self, t):
            return g.frozen(t)

    c2w, intrinsics, _, width, height = cameras(4)
    args = (c2w, intrinsics, torch.tensor([0.5, -0.2, 0.5, 0.9]), width, height)
    for mine, expected in zip(render(Slices(), *args), render(g, *args), strict=True):
        torch.testing.assert_close(mine, expected, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
@pytest.mark.parametrize("name", (*FIELDS, "scale", "rotation", "c2w", "intrinsics", "time"))
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_not_a_number_is_named(name, bad, backend):
    g = gaussians(20) if name in ("scale", "rotation") else cloud(20)
    c2w, intrinsics, time, width, height = cameras()
    cams = {"c2w": c2w, "intrinsics": intrinsics.clone(), "time": time}
    x = (cams[name] if name in cams else getattr(g, name)).clone()
    x.view(-1)[-1] = bad
    if name in cams:
        cams[name] = x
    else:
        g = replace(g, **{name: x})
    with pytest.raises(ValueError, match=f"{name} has 1 value"):
        render(g, **cams, width=width, height=height, backend=backend)


def test_wrong_arguments_are_named():
    g, view = cloud(20), cameras()
    for name in FIELDS[1:]:
        with pytest.raises(ValueError, match=f"{name} has shape"):
            render(replace(g, **{name: getattr(g, name)[:-1]}), *view)
    with pytest.raises(ValueError, match="rotation has shape"):
        render(replace(gaussians(20), rotation=torch.ones(20, 3)), *view)
    with pytest.raises(ValueError, match="time has shape"):
        render(g, *view[:2], view[2][:1], *view[3:])
    with pytest.raises(ValueError, match="opacity has dtype"):
        render(replace(g, opacity=torch.ones(20, dtype=torch.int64)), *view)
    with pytest.raises(ValueError, match="background"):
        render(g, *view, background=torch.zeros(4))
    with pytest.raises(ValueError, match="image size"):
        render(g, *view[:3], 0, 5)
    with pytest.raises(ValueError, match="backend"):
        render(g, *view, backend="opengl")


def test_what_is_not_the_shape_is_not_looked_at():
    """Beside cov3, scale and rotation are what comes of it, and may be anything."""
    g, view = cloud(20), cameras()
    anything = replace(g, scale=torch.full((20, 3), math.nan), rotation=torch.zeros(20, 4))
    assert torch.equal(render(anything, *view)[0], render(g, *view)[0])
