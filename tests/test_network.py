"""The transformer: sizes by hand, the appendix's activations, token dropping, and starting as the geometry."""

import pytest
import torch

from timesplat.model.lift import lift_geometry
from timesplat.model.network import PRESETS, Config, Network, multiply, patchify
from timesplat.model.sweep import sweep_geometry

TINY = {"width": 32, "depth": 2, "heads": 2}


@pytest.fixture(scope="module")
def views(spheres):
    return spheres([0, 1, 2], size=32)


@pytest.mark.parametrize(("name", "width", "depth", "near"), [("large", 1024, 24, 302e6), ("base", 768, 12, 85e6)])
def test_parameter_counts_by_hand(name, width, depth, near):
    with torch.device("meta"):
        count = sum(p.numel() for p in Network(PRESETS[name]).parameters())
    block = 4 * width**2 + 8 * width**2 + 2 * width  # qkv and projection, MLP, two LayerNorms without bias
    hand = depth * block + 64 * 10 * width + width * 64 * 20 + 2 * width
    assert count == hand
    assert abs(depth * block / near - 1) < 0.01


def test_untrained_paper_head_starts_at_the_appendix_biases(views):
    torch.manual_seed(0)
    net = Network(Config(**TINY, head="paper")).eval()
    torch.nn.init.zeros_(net.decode.weight)
    net.decode.weight.data[11] = net.decode.weight.data[15] = 0  # quaternions 0 would have no direction:
    net.decode.weight.requires_grad_(False)
    torch.manual_seed(1)
    for p in range(64):  # … give every pixel some
        net.decode.weight[20 * p + 11 : 20 * p + 19] = torch.randn(8, 32) * 0.1
    g = net(views, drop_empty=False)
    assert len(g) == 3 * 32 * 32
    torch.testing.assert_close(g.opacity, torch.full_like(g.opacity, float(torch.sigmoid(torch.tensor(-2.0)))))
    torch.testing.assert_close(g.rgb, torch.full_like(g.rgb, 0.5))
    S = g.covariance4()
    equal = torch.exp(torch.tensor(-2.3)) ** 2 * torch.eye(4)  # equal scales: any rotation leaves a sphere
    torch.testing.assert_close(S, equal.expand_as(S), atol=1e-6, rtol=1e-4)
    distance = (g.xyz - views.c2w[0, :3, 3])[: 32 * 32].norm(dim=-1)
    torch.testing.assert_close(distance, torch.full_like(distance, 2.3), atol=1e-5, rtol=0)


def test_clamps_hold(views):
    torch.manual_seed(0)
    net = Network(Config(**TINY, head="kinematic"))
    net.decode.weight.data *= 1000
    g = net(views)
    assert g.scale.max() <= 0.3 and g.sigma_t.max() <= 1.0
    assert g.xyz.abs().max() <= 1  # in training only
    assert net.eval()(views).xyz.abs().max() > 1


@pytest.mark.parametrize("head", ["paper", "kinematic"])
def test_dropping_empty_tokens_changes_nothing_where_none_is_empty(views, head):
    torch.manual_seed(0)
    net = Network(Config(**TINY, head=head)).eval()
    full = views[:]
    full.alpha = torch.ones_like(views.alpha)
    a, b = net(full, drop_empty=True), net(full, drop_empty=False)
    for k in ("xyz", "t", "velocity", "opacity", "rgb"):
        torch.testing.assert_close(getattr(a, k), getattr(b, k), rtol=0, atol=0)
    assert len(net(views)) < len(b)


@pytest.mark.parametrize(("source", "make"), [("given", lift_geometry), ("sweep", sweep_geometry)])
def test_untrained_network_equals_its_geometry(views, source, make):
    net = Network(Config(**TINY, source=source)).eval()
    geometry = make(views)
    g = net(views, geometry)
    base = geometry.gaussians
    assert len(g) == len(base) > 0
    for k in ("xyz", "t", "velocity", "sigma_t", "scale", "rotation", "rgb"):
        torch.testing.assert_close(getattr(g, k), getattr(base, k), rtol=0, atol=1e-6)
    torch.testing.assert_close(g.opacity, base.opacity, rtol=0, atol=1e-4)


def test_free_gaussians_join_the_pixels(views):
    torch.manual_seed(0)
    g = Network(Config(**TINY, head="paper", free=5)).eval()(views, drop_empty=False)
    assert len(g) == 3 * 32 * 32 + 5


def test_order_of_views_does_not_matter(views):
    """No position embeddings: pose and time are in the pixels."""
    torch.manual_seed(0)
    net = Network(Config(**TINY)).eval()
    order = [2, 0, 1]
    a, b = net(views, drop_empty=False), net(views[order], drop_empty=False)
    torch.testing.assert_close(a.xyz.unflatten(0, (3, -1))[order].flatten(0, 1), b.xyz, atol=1e-5, rtol=0)


def test_gradients_reach_every_weight(views):
    torch.manual_seed(0)
    net = Network(Config(**TINY, head="paper", free=3))
    g = net(views)
    sum((getattr(g, k) ** 2).sum() for k in ("xyz", "t", "velocity", "sigma_t", "rgb", "opacity")).backward()
    assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in net.parameters())


def test_patchify_keeps_rows_and_columns():
    x = torch.arange(2 * 4 * 6).reshape(2, 4, 6, 1)
    p = patchify(x, 2)
    assert p.shape == (2 * 2 * 3, 4, 1)
    assert p[1, :, 0].tolist() == [2, 3, 8, 9]  # first row of patches, second column


def test_odd_image_size_is_refused(spheres):
    with pytest.raises(ValueError, match="multiples of 8"):
        Network(Config(**TINY))(spheres([0], size=30))


def test_quaternion_product_turns_first_by_the_second():
    from timesplat.model.gaussians import rotation_matrix

    a, b = torch.nn.functional.normalize(torch.randn(2, 7, 4, dtype=torch.float64), dim=-1)
    torch.testing.assert_close(rotation_matrix(multiply(a, b)), rotation_matrix(a) @ rotation_matrix(b))


def test_rows_lead_from_pixels_to_outputs(views):
    """The output that a Gaussian is corrected by is the one of its own pixel."""
    net = Network(Config(**TINY))
    keep = net.kept_patches(views)
    row = net.rows(views, keep)
    number = torch.arange(3 * 32 * 32).reshape(3, 32, 32, 1)
    order = patchify(number, 8)[keep].flatten()
    assert torch.equal(order[row[row >= 0]], (row >= 0).nonzero()[:, 0])
    assert (row < 0).sum() == (~keep).sum() * 64
