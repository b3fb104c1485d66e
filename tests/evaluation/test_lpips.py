"""LPIPS with random weights against its definition, and how weight files are found and refused."""

import pytest
import torch

from timesplat.datagen.sequence import InputError
from timesplat.evaluation.lpips import CHANNELS, LAYERS, find_lpips, load_linear
from timesplat.model.training.vgg import VGG


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Random weights in the two files' formats."""
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("weights")
    torch.save(VGG(16).state_dict(), path / "vgg16.pth")
    torch.save(
        {f"lin{i}.model.1.weight": torch.rand(1, c, 1, 1) for i, c in enumerate(CHANNELS)}, path / "lpips_vgg.pth"
    )
    return path


def test_the_definition(folder, monkeypatch):
    monkeypatch.setenv("TIMESPLAT_WEIGHTS", str(folder))
    lpips = find_lpips()
    x, y = torch.rand(2, 2, 32, 32, 3)
    expected = torch.zeros(2)
    linear = torch.load(folder / "lpips_vgg.pth")
    for i, name in enumerate(LAYERS):
        a, b = (lpips.vgg(z.permute(0, 3, 1, 2), [name])[0] for z in (x, y))
        a, b = (torch.nn.functional.normalize(z, dim=1) for z in (a, b))
        distance = torch.nn.functional.conv2d((a - b) ** 2, linear[f"lin{i}.model.1.weight"])
        expected += distance.mean((1, 2, 3))
    assert lpips(x, y).tolist() == pytest.approx(expected.tolist(), rel=1e-4)
    assert lpips(x, x).tolist() == [0, 0] and (lpips(x, y) > 0).all()


def test_missing_and_damaged_files(folder, tmp_path, monkeypatch):
    monkeypatch.setenv("TIMESPLAT_WEIGHTS", str(tmp_path))
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    assert find_lpips() is None
    bad = tmp_path / "lpips_vgg.pth"
    bad.write_bytes(b"no")
    with pytest.raises(InputError, match=r"lpips_vgg.pth.*copy the file again"):
        load_linear(bad)
    torch.save({f"lin{i}.model.1.weight": torch.rand(1, 3, 1, 1) for i in range(5)}, bad)
    with pytest.raises(InputError, match="wrong sizes"):
        load_linear(bad)
