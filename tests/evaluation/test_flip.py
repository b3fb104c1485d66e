"""ꟻLIP against its definition with dense two-dimensional filters, and against colours worked out by hand."""

import math

import numpy as np
import pytest
import torch

from timesplat.evaluation.flip import error, features, flip

PPD = 67.0
WHITE = np.array([0.950428545, 1.0, 1.088900371])
TO_XYZ = np.array(
    [
        [10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794],
        [2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897],
        [1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382],
    ]
)


def dense(picture, kernel):
    reach = len(kernel) // 2
    padded = np.pad(picture, reach, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, kernel.shape)
    return np.einsum("hwij,ij->hw", windows, kernel)


def hunt(xyz):
    f = np.where(xyz / WHITE > (6 / 29) ** 3, np.cbrt(xyz / WHITE), (29 / 6) ** 2 / 3 * xyz / WHITE + 4 / 29)
    L = 116 * f[..., 1] - 16
    a, b = 500 * (f[..., 0] - f[..., 1]), 200 * (f[..., 1] - f[..., 2])
    return np.stack([L, 0.01 * L * a, 0.01 * L * b], -1)


def hyab(p, q):
    d = p - q
    return np.abs(d[..., 0]) + np.hypot(d[..., 1], d[..., 2])


def redistribute(distance):
    most = hyab(hunt(TO_XYZ[:, 1]), hunt(TO_XYZ[:, 2])) ** 0.7
    p = distance**0.7
    return np.where(p < 0.4 * most, 0.95 * p / (0.4 * most), 0.95 + 0.05 * (p - 0.4 * most) / (0.6 * most))


def by_definition(x, y):
    """The error map of (H,W,3) sRGB pictures as the paper defines it, in float64."""
    r = math.ceil(3 * math.sqrt(0.04 / (2 * math.pi**2)) * PPD)
    grid = np.arange(-r, r + 1) / PPD
    square = grid[:, None] ** 2 + grid[None] ** 2
    csf = []
    for terms in ([(1, 0.0047)], [(1, 0.0053)], [(34.1, 0.04), (13.5, 0.025)]):
        k = sum(a * math.sqrt(math.pi / b) * np.exp(-(math.pi**2) * square / b) for a, b in terms)
        csf.append(k / k.sum())
    sigma = 0.5 * 0.082 * PPD
    v, u = np.mgrid[-math.ceil(3 * sigma) : math.ceil(3 * sigma) + 1, -math.ceil(3 * sigma) : math.ceil(3 * sigma) + 1]
    g = np.exp(-(u**2 + v**2) / (2 * sigma**2))
    detectors = []
    for k in (-u * g, (u**2 / sigma**2 - 1) * g):
        detectors.append(np.where(k > 0, k / k[k > 0].sum(), k / -k[k < 0].sum()))
    colours, found = [], []
    for picture in (x, y):
        linear = np.where(picture > 0.04045, ((picture + 0.055) / 1.055) ** 2.4, picture / 12.92)
        n = linear @ TO_XYZ.T / WHITE
        opponent = [116 * n[..., 1] - 16, 500 * (n[..., 0] - n[..., 1]), 200 * (n[..., 1] - n[..., 2])]
        f = [dense(o, k) for o, k in zip(opponent, csf, strict=True)]
        ny = (f[0] + 16) / 116
        back = np.stack([ny + f[1] / 500, ny, ny - f[2] / 200], -1) * WHITE
        colours.append(hunt(np.clip(back @ np.linalg.inv(TO_XYZ).T, 0, 1) @ TO_XYZ.T))
        y_ = (opponent[0] + 16) / 116
        found.append([np.hypot(dense(y_, k), dense(y_, k.T)) for k in detectors])
    colour = redistribute(hyab(*colours))
    feature = np.maximum(*(np.abs(a - b) for a, b in zip(*found, strict=True))) / math.sqrt(2)
    return colour ** (1 - feature**0.5)


@pytest.fixture
def pair():
    """Two blobs of noise on white, not quite in the same place."""
    rng = np.random.default_rng(0)
    x, y = np.ones((72, 80, 3)), np.ones((72, 80, 3))
    x[20:44, 25:50] = rng.uniform(0, 1, (24, 25, 3))
    y[23:46, 24:50] = rng.uniform(0, 1, (23, 26, 3))
    return x, y


def test_the_definition(pair):
    x, y = (torch.tensor(p, dtype=torch.float32) for p in pair)
    expected = by_definition(*pair)
    assert np.abs(error(features(x), features(y)).numpy() - expected).max() < 2e-4
    assert float(flip(x, y)) == pytest.approx(expected.mean(), abs=1e-5)  # cropped
    known = [features(y)]
    assert float(flip(x[None], y[None], known)[0]) == pytest.approx(expected.mean(), abs=1e-5)


def test_same_pictures_and_order(pair):
    x, y = (torch.tensor(p, dtype=torch.float32) for p in pair)
    assert flip(torch.stack([x, y]), torch.stack([x, y])).tolist() == [0, 0]
    assert float(flip(x, y)) == pytest.approx(float(flip(y, x)), abs=1e-6)
    assert float(flip(torch.ones(16, 16, 3), torch.ones(16, 16, 3))) == 0
    near, far = flip(torch.stack([x + 0.02, x * 0.5]), torch.stack([x, x])).tolist()
    assert 0 < near < far < 1


def test_constant_colours_by_hand():
    """No edges: the error is the redistributed HyAB distance. White and black are 100 apart in L* alone."""

    def of(a, b):
        return float(flip(torch.tensor(a).expand(24, 24, 3), torch.tensor(b).expand(24, 24, 3)))

    most = hyab(hunt(TO_XYZ[:, 1]), hunt(TO_XYZ[:, 2])) ** 0.7
    black_white = 0.95 + 0.05 * (100**0.7 - 0.4 * most) / (0.6 * most)
    assert of([0.0, 0, 0], [1.0, 1, 1]) == pytest.approx(black_white, abs=1e-4)
    assert of([0.0, 1, 0], [0.0, 0, 1]) == pytest.approx(1, abs=1e-4)
    grey = 116 * np.cbrt(((0.5 + 0.055) / 1.055) ** 2.4) - 16  # L* of 50 % sRGB: 53.39
    assert grey == pytest.approx(53.39, abs=0.01)
    assert of([0.5, 0.5, 0.5], [1.0, 1, 1]) == pytest.approx(float(redistribute(100 - grey)), abs=1e-4)
    assert of([2.0, 2, 2], [1.0, 1, 1]) == 0  # clamped
