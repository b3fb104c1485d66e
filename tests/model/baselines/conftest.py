# SPDX-License-Identifier: GPL-3.0-or-later
"""What the baselines' tests share."""

import pytest


@pytest.fixture(scope="session")
def quality():
    """quality(scene, views) -> mean PSNR in dB of the scene's pictures."""
    from timesplat.evaluation.image_quality import psnr
    from timesplat.model.rasterize import render

    def measure(scene, views):
        scene = scene[scene.alive()]
        rgb, _ = render(scene, views.c2w, views.intrinsics, views.time, *views.size, inference=True)
        return float(psnr(rgb, views.over(1.0)).mean())

    return measure
