# SPDX-License-Identifier: GPL-3.0-or-later
"""ꟻLIP: the difference that a person sees who flips between two pictures (Andersson et al., High Performance
Graphics 2020), LDR, at 67 pixels a degree: a 4K screen 0.7 m wide, seen from 0.7 m. No learned weights.

Two pipelines: colours blurred as the eye blurs them, compared in Hunt-adjusted L*a*b* by the HyAB distance; and
edges and points of the luminance, whose difference amplifies that of the colours. 0 is the same, 1 the worst.
All filters are separable (one is the sum of two that are), and each pass is a product with a matrix into
which the replicated border is folded.
"""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from torch import Tensor

from .image_quality import shown

PPD = 67.0  # pixels per degree of visual angle; the authors' default is 0.7 · 3840 / 0.7 · π / 180 = 67.02
QC, QF = 0.7, 0.5  # exponents of the colour and of the feature difference
PC, PT = 0.4, 0.95  # this share of the largest colour difference is mapped to 0.95, the rest to 0.95..1
# Sensitivity to contrast: sums of a √(π/b) exp(-π² r²/b), r in degrees (the paper's table 1).
CSF = {"A": ((1.0, 0.0047),), "RG": ((1.0, 0.0053),), "BY": ((34.1, 0.04), (13.5, 0.025))}
FEATURE = 0.082  # degrees: width of the eye's edge detector from peak to trough, twice its σ
# Linear sRGB (D65) to XYZ; divided by the rows' sums, white is (1,1,1).
XYZ = torch.tensor(
    [
        [10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794],
        [2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897],
        [1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382],
    ],
    dtype=torch.float64,
)
XYZ = XYZ / XYZ.sum(1, keepdim=True)
OPPONENT = torch.tensor([[0, 1, 0], [1, -1, 0], [0, 1, -1]], dtype=torch.float64)  # Y Cx Cz, up to scale and offset
CSF_RADIUS = math.ceil(3 * math.sqrt(0.04 / (2 * math.pi**2)) * PPD)
MARGIN = CSF_RADIUS  # how far a pixel's error can reach


def flip(image: Tensor, target: Tensor, features_of_target: list[Tensor] | None = None) -> Tensor:
    """image, target (…,H,W,3) sRGB -> (…) mean error 0..1 of each image; predictions are clamped to 0..1.

    features_of_target: `features` of each target, if they are at hand. Where both pictures are white for as far
    as the filters reach, the error is 0 and not computed."""
    height, width = image.shape[-3:-1]
    pairs = zip(image.reshape(-1, height, width, 3), target.reshape(-1, height, width, 3), strict=True)
    means = []
    for n, (x, y) in enumerate(pairs):
        rows, columns = shown(x, y, MARGIN)
        if rows.stop == 0:
            means.append(x.new_zeros(()))
            continue
        known = features(y[rows, columns]) if features_of_target is None else features_of_target[n][:, rows, columns]
        means.append(error(features(x[rows, columns]), known).sum() / (height * width))
    return torch.stack(means).reshape(image.shape[:-3])


def features(picture: Tensor) -> Tensor:
    """picture (H,W,3) sRGB, clamped to 0..1 -> (5,H,W): what is seen of it. Hunt-adjusted L*, a*, b* after the
    eye's blur, and how strong an edge and a point the luminance has there."""
    height, width = picture.shape[:2]
    to_opponent = (OPPONENT @ XYZ).to(picture)
    opponent = torch.einsum("ij,hwj->ihw", to_opponent, linear(picture.clamp(0, 1)))

    def passes(x: Tensor, down: str, across: str) -> Tensor:
        return _matrix(down, height).to(x) @ x @ _matrix(across, width).to(x).T

    blue = torch.zeros_like(opponent[2])
    for i, k in enumerate(_shares("BY")):
        blue = blue + k * passes(opponent[2], f"BY{i}", f"BY{i}")
    seen = torch.stack([passes(opponent[0], "A0", "A0"), passes(opponent[1], "RG0", "RG0"), blue])
    rgb = torch.einsum("ij,jhw->ihw", torch.linalg.inv(OPPONENT @ XYZ).to(picture), seen).clamp(0, 1)
    lab = hunt(torch.einsum("ij,jhw->ihw", XYZ.to(picture), rgb))
    y = opponent[0]
    edge = torch.hypot(passes(y, "smooth", "edge"), passes(y, "edge", "smooth"))
    point = torch.hypot(passes(y, "smooth", "point"), passes(y, "point", "smooth"))
    return torch.cat([lab, edge[None], point[None]])


def error(a: Tensor, b: Tensor) -> Tensor:
    """Two `features` (5,H,W) -> (H,W) error 0..1 of each pixel."""
    colour = redistribute((a[0] - b[0]).abs() + torch.hypot(a[1] - b[1], a[2] - b[2]))
    feature = (a[3:] - b[3:]).abs().amax(0) / math.sqrt(2)
    return colour ** (1 - feature**QF)


def linear(srgb: Tensor) -> Tensor:
    """sRGB-encoded 0..1 -> linear light."""
    return torch.where(srgb > 0.04045, ((srgb + 0.055) / 1.055) ** 2.4, srgb / 12.92)


def hunt(xyz: Tensor) -> Tensor:
    """xyz (3,…), white (1,1,1) -> (3,…) L*, and a*, b* weighted by L*/100: dark colours look less colourful."""
    x, y, z = torch.where(xyz > (6 / 29) ** 3, xyz.clamp_min(1e-9) ** (1 / 3), xyz * (29 / 6) ** 2 / 3 + 4 / 29)
    L = 116 * y - 16
    return torch.stack([L, 0.01 * L * 500 * (x - y), 0.01 * L * 200 * (y - z)])


def redistribute(hyab: Tensor) -> Tensor:
    """HyAB distances -> 0..1; the largest is between green and blue."""
    green, blue = (hunt(XYZ[:, i]) for i in (1, 2))
    d = (green - blue).abs()
    most = float(d[0] + torch.hypot(d[1], d[2])) ** QC
    power, knee = hyab**QC, PC * most
    return torch.where(power < knee, PT / knee * power, PT + (power - knee) / (most - knee) * (1 - PT))


def _gaussian(b: float) -> Tensor:
    r = torch.arange(-CSF_RADIUS, CSF_RADIUS + 1, dtype=torch.float64) / PPD
    return torch.exp(-(math.pi**2) * r**2 / b)


@lru_cache(maxsize=8)
def _shares(channel: str) -> tuple[float, ...]:
    """The weight of each Gaussian of a channel when each has the sum 1 and so has their sum."""
    sums = [a * math.sqrt(math.pi / b) * float(_gaussian(b).sum()) ** 2 for a, b in CSF[channel]]
    return tuple(s / sum(sums) for s in sums)


@lru_cache(maxsize=256)
def _matrix(name: str, size: int) -> Tensor:
    """(size, size) float32: correlation along an axis with one of the filters, the border replicated. "A0" is the
    first Gaussian of channel A; "smooth", "edge", "point" the feature detectors' Gaussian and derivatives, whose
    positive and negative weights each have the sum 1."""
    if name[-1].isdigit():
        kernel = _gaussian(CSF[name[:-1]][int(name[-1])][1])
        kernel = kernel / kernel.sum()
    else:
        sigma = 0.5 * FEATURE * PPD
        radius = math.ceil(3 * sigma)
        x = torch.arange(-radius, radius + 1, dtype=torch.float64)
        kernel = torch.exp(-0.5 * (x / sigma) ** 2)
        kernel = kernel * {"smooth": torch.ones_like(x), "edge": -x, "point": (x / sigma) ** 2 - 1}[name]
        plus, minus = kernel.clamp_min(0), kernel.clamp_max(0)
        kernel = plus / plus.sum() + minus / (-minus.sum()).clamp_min(1e-12)
    reach = len(kernel) // 2
    out = torch.zeros(size, size, dtype=torch.float64)
    row = torch.arange(size)
    for i, k in enumerate(kernel.tolist()):
        out[row, (row + i - reach).clamp(0, size - 1)] += k
    return out.float()
