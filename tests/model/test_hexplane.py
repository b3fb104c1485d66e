# SPDX-License-Identifier: GPL-3.0-or-later
"""The HexPlane variant: reading the planes by hand, motion from them, and what a scene must answer."""

import pytest
import torch

from timesplat.datagen.sequence import InputError
from timesplat.model import hexplane
from timesplat.model.gaussians import Gaussians4D
from timesplat.model.network import Config, Network
from timesplat.model.rasterize import render

TINY = {"width": 32, "depth": 1, "heads": 2, "motion": "hexplane"}


@pytest.fixture
def scene(spheres):
    torch.manual_seed(0)
    return Network(Config(**TINY)).eval()(spheres([0, 12, 23], size=32))


def moving(scene):
    """The same scene with a last layer that does something."""
    weights = [*scene.weights[:-1], 0.05 * torch.randn_like(scene.weights[-1])]
    return hexplane.Deformed(scene.canonical, scene.planes, weights)


def test_planes_are_put_together_from_tokens():
    x = torch.zeros(hexplane.TOKENS, hexplane.CELLS**2 * hexplane.CHANNELS)
    # plane yz (2), second row of tokens, third column; in it row 4, column 5, channel 6
    token, inside = 2 * 16 + 1 * 4 + 2, (4 * 8 + 5) * 16 + 6
    x[token, inside] = 7
    planes = hexplane.planes_from_tokens(x)
    assert planes.shape == (6, 16, 32, 32)
    assert planes[2, 6, 8 + 4, 16 + 5] == 8
    planes[2, 6, 12, 21] = 1
    assert (planes == 1).all()


def test_planes_are_read_at_their_own_axes(scene):
    """A plane that is linear in its two coordinates is read exactly; the features are the product of the six."""
    R, C = 32, hexplane.CHANNELS
    line = torch.linspace(-1, 1, R)
    row, column = torch.meshgrid(line, line, indexing="ij")
    one = torch.stack([1 + 0.3 * column + 0.1 * k * row for k in range(6)])
    scene.planes = one[:, None].expand(6, C, R, R).contiguous()
    g = scene.canonical
    g.xyz = g.xyz.clamp(-1, 1)
    x, y, z = g.xyz.unbind(-1)
    t = torch.full_like(x, 0.4)
    pairs = [(x, y), (x, z), (y, z), (x, t), (y, t), (z, t)]
    hand = torch.stack([1 + 0.3 * a + 0.1 * k * b for k, (a, b) in enumerate(pairs)]).prod(0)
    torch.testing.assert_close(scene.features(0.4), hand[:, None].expand(-1, C), atol=1e-5, rtol=1e-5)


def test_an_untrained_scene_stands_still_and_lives_for_ever(scene):
    a, b = scene.at(-1.0), scene.at(0.7)
    for k in ("xyz", "scale", "rotation", "rgb", "opacity"):
        assert torch.equal(getattr(a, k), getattr(b, k))
    torch.testing.assert_close(a.xyz, scene.canonical.xyz)
    assert torch.equal(a.opacity * a.marginal(torch.tensor(-1.0)), scene.canonical.opacity)


def test_a_trained_scene_moves_turns_and_grows(scene):
    scene = moving(scene)
    a, b = scene.at(-1.0), scene.at(0.7)
    for k in ("xyz", "scale", "rotation"):
        assert (getattr(a, k) - getattr(b, k)).abs().max() > 1e-4
    assert a.scale.max() <= 0.3
    torch.testing.assert_close(a.rotation.norm(dim=-1), torch.ones(len(a)))


def test_what_evaluation_asks_for(scene, spheres):
    scene = moving(scene).to("cpu")
    kept = scene[scene.alive()]
    assert isinstance(scene.at(0.0), Gaussians4D) and len(kept) == int((scene.canonical.opacity >= 0.05).sum())
    torch.testing.assert_close(kept.at(0.3).xyz, scene.at(0.3).xyz[scene.alive()])
    views = spheres([0, 23, 0], size=32)
    with torch.inference_mode():
        rgb, _ = render(kept, views.c2w, views.intrinsics, views.time, 32, 32, inference=True)
    assert rgb.shape == (3, 32, 32, 3) and torch.equal(rgb[0], rgb[2])


def test_gradients_reach_every_weight(spheres):
    torch.manual_seed(0)
    views = spheres([0, 12], size=32)
    net = Network(Config(**TINY, free=3))
    torch.nn.init.normal_(net.deform[-1].weight, std=0.05)
    g = net(views).at(0.5)
    sum((x**2).sum() for x in (g.xyz, g.scale.log(), g.rotation * torch.randn(4), g.rgb, g.opacity)).backward()
    assert all(p.grad is not None and p.grad.isfinite().all() and (p.grad != 0).any() for p in net.parameters())


@pytest.mark.parametrize("more", [{"source": "sweep"}, {"time": "aligned"}])
def test_what_does_not_go_together_is_refused(more):
    with pytest.raises(InputError, match="hexplane"):
        Config(**TINY, **more)
