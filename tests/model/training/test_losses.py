"""What training minimises, by hand."""

import pytest
import torch

from timesplat.model.geometry.lift import lift, lift_geometry
from timesplat.model.network import Config, Network
from timesplat.model.training.losses import (
    PERCEPTUAL_LAYERS,
    PixelTruth,
    geometric_loss,
    load_perceptual_loss,
    photometric_loss,
    pixel_truth,
)
from timesplat.model.training.vgg import IMAGENET_STD, VGG


def test_photometric_loss_by_hand(spheres):
    targets = spheres([0], size=16)
    white = torch.ones(3)
    assert float(photometric_loss(targets.over(1.0), targets.alpha, targets, white)) == 0
    off = photometric_loss(targets.over(1.0) + 0.1, targets.alpha, targets, white)
    assert float(off) == pytest.approx(0.01, rel=1e-4)
    assert float(photometric_loss(targets.over(1.0), targets.alpha * 0, targets, white)) == pytest.approx(
        0.3 * float(targets.alpha.mean()), rel=1e-5
    )


def test_geometric_loss_vanishes_at_the_truth(spheres):
    g = lift(spheres([0, 1], size=16))
    t, known = torch.zeros(len(g)), torch.ones(len(g), dtype=torch.bool)
    truth = PixelTruth(g, t, known)
    assert float(geometric_loss(g, truth)) == 0
    assert float(geometric_loss(g, PixelTruth(g, t, ~known))) == 0
    away = g.map(lambda x: x.clone())
    away.xyz += 1
    assert float(geometric_loss(away, truth)) > 0.5


def test_the_truth_of_pixels_is_their_lift(spheres):
    """In the order of the network's Gaussians, with a geometry and without; known where there is a surface."""
    inputs = spheres([0, 1], size=16)
    lifted = lift_geometry(inputs)
    truth = pixel_truth(Network(Config(width=32, depth=1, heads=2, source="given")), inputs, lifted)
    assert len(truth) == len(lifted.pixel_index) and truth.known.all()
    assert set(truth.view_time.tolist()) == set(inputs.time.tolist())
    mine, others = lifted.gaussians, lifted.gaussians[torch.arange(len(truth)).flip(0)]
    assert float(geometric_loss(mine, truth)) < 0.01 < 0.1 < float(geometric_loss(others, truth))
    network = Network(Config(width=32, depth=1, heads=2, head="paper"))
    truth = pixel_truth(network, inputs, None)
    assert len(truth) == len(network(inputs)) > truth.known.sum() == torch.isfinite(inputs.depth).sum()


@pytest.fixture
def perceptual(tmp_path, monkeypatch):
    """With random weights, from a file."""
    torch.manual_seed(0)
    torch.save(VGG(19).state_dict(), tmp_path / "vgg19-dcbb9e9d.pth")
    monkeypatch.setenv("TIMESPLAT_WEIGHTS", str(tmp_path))
    return load_perceptual_loss()


def test_perceptual_loss_by_hand(perceptual):
    torch.manual_seed(1)
    rgb, wanted = torch.rand(2, 32, 32, 3, requires_grad=True), torch.rand(2, 32, 32, 3)
    assert float(perceptual(wanted, wanted)) == 0
    loss = perceptual(rgb, wanted)
    by_hand = (rgb - wanted).abs().mean()
    network = VGG(19, pool="average")
    network.load_state_dict(perceptual.network.state_dict())
    for layer, weight in PERCEPTUAL_LAYERS.items():
        a, b = (network(x.permute(0, 3, 1, 2), [layer])[0] for x in (rgb, wanted))
        by_hand = by_hand + weight * sum(IMAGENET_STD) / 3 * (a - b).abs().mean()
    torch.testing.assert_close(loss, by_hand)
    loss.backward()
    assert rgb.grad.abs().sum() > 0
    halves = (perceptual(rgb[:1], wanted[:1]) + perceptual(rgb[1:], wanted[1:])) / 2
    torch.testing.assert_close(loss, halves)  # a mean over views, as deferred backpropagation needs it


def test_without_weights_one_line_says_so(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("TIMESPLAT_WEIGHTS", str(tmp_path))
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    assert load_perceptual_loss() is None
    assert len(capsys.readouterr().err.splitlines()) == 1
