"""VGG features: torchvision's names and order, safe loading, and where weights are looked for."""

import pytest
import torch

from timesplat.datagen.sequence import InputError
from timesplat.model.training.vgg import IMAGENET_MEAN, IMAGENET_STD, VGG, find_weights


def test_layers_are_where_torchvision_has_them():
    """Indices as in torchvision's state dicts: 16 and 19 layers with weights, three of them the classifier's."""
    for depth, convolutions in ((16, 13), (19, 16)):
        assert sum(k.endswith("weight") for k in VGG(depth).state_dict()) == convolutions
    at = VGG(16).names.index
    assert [at(x) for x in ("relu1_2", "relu2_2", "relu3_3", "relu4_3", "relu5_3")] == [3, 8, 15, 22, 29]
    at = VGG(19).names.index
    assert [at(x) for x in ("relu1_2", "relu2_2", "relu3_2", "relu4_2", "relu5_2")] == [3, 8, 13, 22, 31]
    assert list(VGG(16).state_dict())[-1] == "features.28.bias"
    assert VGG(19).features[34].weight.shape == (512, 512, 3, 3)


@pytest.fixture
def weights(tmp_path, monkeypatch):
    """A file of random weights with a classifier, in a folder that $TIMESPLAT_WEIGHTS names."""
    torch.manual_seed(0)
    state = VGG(16).state_dict() | {"classifier.0.weight": torch.zeros(2, 2)}
    path = tmp_path / "vgg16-397923af.pth"
    torch.save(state, path)
    torch.save({}, tmp_path / "vgg16_bn-6c64b313.pth")
    monkeypatch.setenv("TIMESPLAT_WEIGHTS", str(tmp_path))
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "hub"))
    return path


def test_features_by_hand(weights):
    network = VGG(16).load(find_weights("vgg16"))
    x = torch.rand(2, 3, 32, 32, requires_grad=True)
    low, high = network(x, ["relu1_1", "pool2"])
    assert low.shape == (2, 64, 32, 32) and high.shape == (2, 128, 8, 8)
    normal = (x - torch.tensor(IMAGENET_MEAN)[:, None, None]) / torch.tensor(IMAGENET_STD)[:, None, None]
    first = network.features[0]
    torch.testing.assert_close(low, torch.nn.functional.conv2d(normal, first.weight, first.bias, padding=1).relu())
    high.sum().backward()
    assert x.grad.abs().sum() > 0 and first.weight.grad is None


def test_weights_are_found_or_not(weights, tmp_path, monkeypatch):
    assert find_weights("vgg16") == weights and find_weights("vgg19") is None
    monkeypatch.delenv("TIMESPLAT_WEIGHTS")
    assert find_weights("vgg16") is None
    (tmp_path / "hub" / "checkpoints").mkdir(parents=True)
    weights.rename(tmp_path / "hub" / "checkpoints" / "vgg16.pth")
    assert find_weights("vgg16").name == "vgg16.pth"


@pytest.mark.parametrize("damage", ["missing", "cut", "other", "nan"])
def test_damaged_weights_are_refused(weights, damage):
    if damage == "missing":
        weights.unlink()
    elif damage == "cut":
        weights.write_bytes(weights.read_bytes()[:1000])
    elif damage == "other":
        torch.save(VGG(19).state_dict(), weights)
    else:
        torch.save({k: v * float("nan") for k, v in VGG(16).state_dict().items()}, weights)
    with pytest.raises(InputError, match="vgg16"):
        VGG(16).load(weights)
