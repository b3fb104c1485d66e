# SPDX-License-Identifier: GPL-3.0-or-later
"""Features by name: their order is the checkpoints', and each holds what its name says, from both sources."""

import pytest
import torch

from timesplat.model.geometry.features import LAYOUTS, LIFT_FEATURES, SWEEP_FEATURES, Features
from timesplat.model.geometry.lift import lift_geometry
from timesplat.model.geometry.plane_sweep import expected_lifetime, sweep_depth, sweep_geometry
from timesplat.model.views import camera_rays


@pytest.fixture(scope="module")
def views(spheres):
    return spheres([0, 1, 2, 3], size=32)


@pytest.fixture(scope="module")
def lifted(views):
    return lift_geometry(views)


@pytest.fixture(scope="module")
def swept(views):
    return sweep_geometry(views)


def test_the_order_is_that_of_the_checkpoints():
    given = ["distance", *["normal"] * 3, *["motion"] * 3, "frames_before", "frames_after", "agreeing_views"]
    given += ["contradicted", "alpha"]
    sweep = ["distance", "spread", "certainty", "alpha", "lifetime", *["normal"] * 3, "edge_offset", "frames_before"]
    sweep += ["frames_after", "agreeing_views"]
    for layout, names in ((LIFT_FEATURES, given), (SWEEP_FEATURES, sweep)):
        assert [k for k, n in layout.widths.items() for _ in range(n)] == names
        assert layout.width == 12
    assert LAYOUTS == {"given": LIFT_FEATURES, "sweep": SWEEP_FEATURES}


def test_built_by_name_and_read_by_name():
    valid = torch.tensor([[[True, False], [False, True]]])
    parts = {k: torch.rand(2, n) if n > 1 else torch.rand(2) for k, n in LIFT_FEATURES.widths.items()}
    features = Features.build(LIFT_FEATURES, valid, **parts)
    for k, part in parts.items():
        assert torch.equal(features[k][valid], part) and not features[k][~valid].any()
    with pytest.raises(ValueError, match="alpha"):
        Features.build(LIFT_FEATURES, valid, **{k: x for k, x in parts.items() if k != "alpha"})


def test_what_both_sources_say_alike(views, lifted, swept):
    depth = sweep_depth(views)[0]
    ray = camera_rays(views.intrinsics, *views.size)
    for features, z in ((lifted.features, torch.where(views.alpha > 0.5, views.depth, 0)), (swept.features, depth)):
        valid = z > 0
        assert torch.equal(features["alpha"][valid], views.alpha[valid])
        distance = (z[..., None] * ray).norm(dim=-1)
        torch.testing.assert_close(2.7 * (features["distance"] + 1)[valid], distance[valid])
        torch.testing.assert_close(features["normal"][valid].norm(dim=-1), torch.ones(int(valid.sum())))
        towards = -torch.einsum("vij,vhwj->vhwi", views.c2w[:, :3, :3], ray)
        assert ((features["normal"] * towards).sum(-1)[valid] > -1e-5).all()
        assert not features.values[~valid].any()
        for k in ("frames_before", "frames_after", "agreeing_views"):
            assert (features[k] >= 0).all() and features[k].max() > 0


def test_what_the_lift_says_alone(spheres, views, lifted):
    assert set(lifted.features["contradicted"].unique().tolist()) <= {0.0, 1.0}
    moved = lifted.features["motion"][views.alpha > 0.5] / 0.3 * views.frame_step  # per frame
    assert 0.01 < moved.norm(dim=-1).median() < 0.04  # speeds are 0.022 to 0.025 a frame


def test_what_the_sweep_says_alone(views, swept):
    depth, spread, certainty = sweep_depth(views)
    valid = depth > 0
    for k, truth in (("spread", spread), ("certainty", certainty)):
        assert torch.equal(swept.features[k][valid], truth[valid])
    lifetime = (0.25 * expected_lifetime(views))[:, None, None].expand_as(depth)
    assert torch.equal(swept.features["lifetime"][valid], lifetime[valid])
    offset = swept.features["edge_offset"]
    assert (offset >= 0).all() and (offset <= 1).all() and offset[valid].max() > 0.5


def test_it_goes_to_a_device_whole(lifted):
    moved = lifted.to("meta")
    assert moved.features.values.is_meta and moved.gaussians.xyz.is_meta and moved.pixel_index.is_meta
    assert moved.features.layout == lifted.features.layout
