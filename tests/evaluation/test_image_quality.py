"""Scores against hand-worked values and, for SSIM, a direct double loop."""

import math

import pytest
import torch

from timesplat.evaluation.image_quality import _ssim, psnr, psnr_foreground, shown, ssim


def test_psnr_of_a_known_error():
    a = torch.zeros(2, 8, 8, 3)
    b = torch.stack([a[0] + 0.1, a[1] + 0.5])
    assert psnr(b, a).tolist() == pytest.approx([20.0, -10 * math.log10(0.25)], abs=1e-4)
    assert float(psnr(a - 5, a)[0]) == pytest.approx(100)  # clamped first; equal pictures end at 100 dB


def test_foreground_psnr_counts_only_the_object():
    target, image = torch.ones(1, 8, 8, 3), torch.ones(1, 8, 8, 3)
    alpha = torch.zeros(1, 8, 8)
    alpha[:, :2] = 1
    image[:, :2] -= 0.1
    assert float(psnr_foreground(image, target, torch.zeros(1, 8, 8), alpha)) == pytest.approx(20, abs=1e-4)
    assert float(psnr(image, target)) == pytest.approx(20 + 10 * math.log10(4), abs=1e-4)


def test_ssim_against_the_definition():
    torch.manual_seed(0)
    a, b = torch.rand(1, 14, 13, 3, dtype=torch.float64), torch.rand(1, 14, 13, 3, dtype=torch.float64)
    r = torch.arange(11, dtype=torch.float64) - 5
    w = torch.exp(-0.5 * (r[:, None] ** 2 + r[None] ** 2) / 1.5**2)
    w /= w.sum()
    scores = []
    for c in range(3):
        for y in range(4):
            for x in range(3):
                p, q = a[0, y : y + 11, x : x + 11, c], b[0, y : y + 11, x : x + 11, c]
                mp, mq = (w * p).sum(), (w * q).sum()
                vp, vq, cov = (w * (p - mp) ** 2).sum(), (w * (q - mq) ** 2).sum(), (w * (p - mp) * (q - mq)).sum()
                scores.append((2 * mp * mq + 1e-4) * (2 * cov + 9e-4) / ((mp**2 + mq**2 + 1e-4) * (vp + vq + 9e-4)))
    assert float(ssim(a, b)) == pytest.approx(float(torch.stack(scores).mean()), abs=1e-9)
    assert float(ssim(a, a)) == pytest.approx(1)


def test_ssim_of_a_crop_is_that_of_the_whole():
    torch.manual_seed(1)
    for top, left, height, width in ((30, 20, 12, 25), (0, 60, 9, 20), (40, 0, 40, 80), (33, 33, 1, 1)):
        a, b = torch.ones(2, 80, 80, 3, dtype=torch.float64), torch.ones(2, 80, 80, 3, dtype=torch.float64)
        a[:, top : top + height, left : left + width] = torch.rand(2, height, width, 3, dtype=torch.float64)
        b[:, top : top + height, left : left + width] = torch.rand(2, height, width, 3, dtype=torch.float64)
        b[1] = 1  # nothing there
        whole = torch.stack([_ssim(x.movedim(-1, 0), y.movedim(-1, 0)).mean() for x, y in zip(a, b, strict=True)])
        assert ssim(a, b).tolist() == pytest.approx(whole.tolist(), abs=1e-12)
    assert ssim(torch.ones(3, 16, 16, 3), torch.ones(3, 16, 16, 3)).tolist() == [1, 1, 1]


def test_the_box_of_what_is_shown():
    a, b = torch.ones(100, 90, 3), torch.ones(100, 90, 3)
    a[50, 40, 1] = 0.5
    b[60, 45, 0] = 0
    rows, columns = shown(a, b, 3)
    assert (rows, columns) == (slice(47, 79), slice(37, 53))  # 17 and 12 pixels wide, grown to multiples of 16
    b[99, 89] = 0
    assert shown(a, b, 3)[0].stop == 100 and shown(a, b, 200) == (slice(0, 100), slice(0, 90))
    assert shown(torch.ones(8, 8, 3), torch.ones(8, 8, 3), 3) == (slice(0, 0), slice(0, 0))
