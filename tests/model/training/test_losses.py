"""What training minimises, and deferred backpropagation through the rasteriser."""

import tracemalloc
from dataclasses import replace

import pytest
import torch

from timesplat.model.gaussians import FIELDS
from timesplat.model.geometry.lift import lift
from timesplat.model.rasterize import render
from timesplat.model.training.deferred import Cut
from timesplat.model.training.losses import LAYERS, geometric, load_perceptual, photometric
from timesplat.model.training.vgg import STD, VGG


def test_photometric_loss_by_hand(spheres):
    targets = spheres([0], size=16)
    white = torch.ones(3)
    assert float(photometric(targets.over(1.0), targets.alpha, targets, white)) == 0
    off = photometric(targets.over(1.0) + 0.1, targets.alpha, targets, white)
    assert float(off) == pytest.approx(0.01, rel=1e-4)
    assert float(photometric(targets.over(1.0), targets.alpha * 0, targets, white)) == pytest.approx(
        0.3 * float(targets.alpha.mean()), rel=1e-5
    )


def test_geometric_loss_vanishes_at_the_truth(spheres):
    g = lift(spheres([0, 1], size=16))
    t, known = torch.zeros(len(g)), torch.ones(len(g), dtype=torch.bool)
    assert float(geometric(g, t, g, known)) == 0
    assert float(geometric(g, t, g, ~known)) == 0
    away = g.map(lambda x: x.clone())
    away.xyz += 1
    assert float(geometric(away, t, g, known)) > 0.5


@pytest.fixture
def perceptual(tmp_path, monkeypatch):
    """With random weights, from a file."""
    torch.manual_seed(0)
    torch.save(VGG(19).state_dict(), tmp_path / "vgg19-dcbb9e9d.pth")
    monkeypatch.setenv("TIMESPLAT_WEIGHTS", str(tmp_path))
    return load_perceptual()


def test_perceptual_loss_by_hand(perceptual):
    torch.manual_seed(1)
    rgb, wanted = torch.rand(2, 32, 32, 3, requires_grad=True), torch.rand(2, 32, 32, 3)
    assert float(perceptual(wanted, wanted)) == 0
    loss = perceptual(rgb, wanted)
    by_hand = (rgb - wanted).abs().mean()
    network = VGG(19, pool="average")
    network.load_state_dict(perceptual.network.state_dict())
    for layer, weight in LAYERS.items():
        a, b = (network(x.permute(0, 3, 1, 2), [layer])[0] for x in (rgb, wanted))
        by_hand = by_hand + weight * sum(STD) / 3 * (a - b).abs().mean()
    torch.testing.assert_close(loss, by_hand)
    loss.backward()
    assert rgb.grad.abs().sum() > 0
    halves = (perceptual(rgb[:1], wanted[:1]) + perceptual(rgb[1:], wanted[1:])) / 2
    torch.testing.assert_close(loss, halves)  # a mean over views, as deferred backpropagation needs it


def test_without_weights_one_line_says_so(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("TIMESPLAT_WEIGHTS", str(tmp_path))
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    assert load_perceptual() is None
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_deferred_backpropagation_is_exact_and_keeps_less(spheres):
    """Against one graph through all views: the same gradients in half the memory or less."""
    base = lift(spheres([0, 6, 12, 18], size=48))
    targets = spheres(list(range(12)), [(30 * i, 10) for i in range(12)], size=48)
    background = torch.tensor([1.0, 0.5, 0.2])

    def loss(rgb, alpha, few):
        return photometric(rgb, alpha, few, background)

    def network():
        leaves = base.map(lambda x: x.detach().clone().requires_grad_())
        return leaves, replace(leaves, scale=leaves.scale * 1.5, rgb=leaves.rgb * 0.5, xyz=leaves.xyz.tanh())

    def whole():
        leaves, g = network()
        height, width = targets.size
        pictures = render(g, targets.c2w, targets.intrinsics, targets.time, width, height, background=background)
        total = loss(*pictures, targets) + 0.1 * g.opacity.mean()
        total.backward()
        return leaves, float(total.detach())

    def deferred(chunk):
        leaves, g = network()
        cut = Cut(g)
        total, _ = cut.views_loss(targets, background, loss, chunk)
        more = 0.1 * g.opacity.mean()
        cut.backward(1.0, more)
        return leaves, total + float(more.detach())

    def measured(f, *args):
        tracemalloc.start()
        found = f(*args)
        peak = tracemalloc.get_traced_memory()[1]  # numpy's arrays: all that the rasteriser keeps
        tracemalloc.stop()
        return *found, peak

    whole()  # compiles
    reference, total, peak = measured(whole)
    for chunk in (1, 5, 12):
        leaves, other, less = measured(deferred, chunk)
        assert other == pytest.approx(total, rel=1e-5)
        for k in FIELDS:
            a, b = getattr(reference, k).grad, getattr(leaves, k).grad
            assert (a - b).norm() <= 1e-4 * a.norm(), k
        if chunk == 1:
            assert less < peak / 2


def test_what_is_not_finite_is_seen(spheres):
    g = lift(spheres([0], size=16))
    assert Cut(g).finite()
    g.xyz[0, 0] = float("nan")
    assert not Cut(g).finite()
