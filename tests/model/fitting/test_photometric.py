# SPDX-License-Identifier: GPL-3.0-or-later
"""The compiled error of pictures against torch's in float64, and SSIM against the one that figures are made of."""

import pytest
import torch

from timesplat.evaluation.image_quality import _ssim
from timesplat.model.fitting.photometric import _by_torch, _ssim_by_torch, photometric_error
from timesplat.model.views import Views


def pictures(height, width, count=2, dtype=torch.float32):
    g = torch.Generator().manual_seed(height)
    rgb, true = torch.rand(2, count, height, width, 3, generator=g)
    alpha, cover = torch.rand(2, count, height, width, generator=g)
    views = Views(true, cover.round(), torch.eye(4).expand(count, 4, 4), torch.ones(count, 4), torch.zeros(count), 1.0)
    return rgb, alpha, views, torch.tensor([0.2, 0.5, 0.9])


@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("size", [(7, 5), (40, 67)])
def test_value_and_gradient_are_those_of_autograd(size, weight):
    rgb, alpha, views, background = pictures(*size)
    found = []
    for function, dtype in ((photometric_error, torch.float32), (_by_torch, torch.float64)):
        x, a = (v.to(dtype, copy=True).requires_grad_() for v in (rgb, alpha))
        truth = Views(*(getattr(views, k).to(dtype) for k in ("rgb", "alpha", "c2w", "intrinsics", "time")), 1.0)
        value = function(x, a, truth, background.to(dtype), weight)
        (3 * value).backward()
        found.append((value.detach(), x.grad, a.grad))
    for a, b in zip(*found, strict=True):
        assert (a - b).abs().max() < 1e-5 * b.abs().max() + 1e-12


def test_ssim_is_that_of_the_tables_with_black_around():
    rgb, _, views, _ = pictures(40, 67, 1)
    around = (torch.nn.functional.pad(x[0].movedim(-1, 0).double(), (5, 5, 5, 5)) for x in (rgb, views.rgb))
    assert torch.isclose(_ssim(*around).mean(), _ssim_by_torch(rgb.double(), views.rgb.double()), atol=1e-7)


def test_the_same_pictures_have_no_error():
    rgb, _, views, background = pictures(20, 20)
    assert photometric_error(views.over(background), views.alpha.clone(), views, background, 0.2) < 1e-6
    assert photometric_error(rgb, views.alpha.clone(), views, background, 0.2) > 0.1


def test_what_is_far_from_the_object_need_not_be_looked_at():
    """An object in a corner of an empty picture, and one that is drawn a little beside it: exact all the same."""
    rgb, alpha, views, background = pictures(70, 90)
    shown, drawn = torch.zeros(2, *alpha.shape)
    shown[:, 20:31, 30:50], drawn[:, 24:36, 27:44] = 1, 1
    views.alpha, alpha = views.alpha * shown, alpha * drawn
    rgb = rgb * alpha[..., None] + background * (1 - alpha[..., None])
    found = []
    for function, dtype in ((photometric_error, torch.float32), (_by_torch, torch.float64)):
        x = rgb.to(dtype, copy=True).requires_grad_()
        truth = Views(*(getattr(views, k).to(dtype) for k in ("rgb", "alpha", "c2w", "intrinsics", "time")), 1.0)
        value = function(x, alpha.to(dtype), truth, background.to(dtype), 0.2)
        value.backward()
        found.append((value.detach(), x.grad * drawn[..., None]))  # elsewhere only rounding says which way is up
    for a, b in zip(*found, strict=True):
        assert (a - b).abs().max() < 5e-5 * b.abs().max()
    empty = Views(views.rgb, 0 * views.alpha, views.c2w, views.intrinsics, views.time, 1.0)
    assert photometric_error(background.expand(rgb.shape), 0 * alpha, empty, background, 0.2) == 0
