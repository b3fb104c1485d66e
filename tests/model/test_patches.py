# SPDX-License-Identifier: GPL-3.0-or-later
"""Pixels patch by patch: their order, their rays, and the way back from pixels to places."""

import pytest
import torch

from timesplat.model.patches import gather_pixels, in_patches, patch_rays, pixel_places
from timesplat.model.views import rays


@pytest.fixture(scope="module")
def views(spheres):
    return spheres([0, 1, 2], size=32)


def test_pixels_are_gathered_patch_by_patch():
    x = torch.arange(2 * 4 * 6).reshape(2, 4, 6)
    keep = torch.ones(2 * 2 * 3, dtype=torch.bool)
    got = gather_pixels(x, keep, 2)
    assert got.shape == (2 * 2 * 3, 4)
    assert got[1].tolist() == [2, 3, 8, 9]  # first row of patches, second column
    keep[0] = False
    assert torch.equal(gather_pixels(x[..., None], keep, 2), got[1:, :, None])


def test_rays_of_patches_are_those_of_the_pictures(views):
    keep = in_patches(views.alpha, 8).amax((2, 4)).flatten() > 0
    assert 0 < keep.sum() < len(keep)
    whole = rays(views.c2w, views.intrinsics, *views.size)
    for a, b in zip(patch_rays(views, keep, 8), whole, strict=True):
        torch.testing.assert_close(a, gather_pixels(b, keep, 8), atol=1e-6, rtol=0)


def test_places_lead_from_pixels_to_outputs(views):
    """The output that a Gaussian is corrected by is the one of its own pixel."""
    keep = in_patches(views.alpha, 8).amax((2, 4)).flatten() > 0
    place = pixel_places(views, keep, 8)
    number = torch.arange(3 * 32 * 32).reshape(3, 32, 32)
    order = gather_pixels(number, keep, 8).flatten()
    assert torch.equal(order[place[place >= 0]], (place >= 0).nonzero()[:, 0])
    assert (place < 0).sum() == (~keep).sum() * 64
