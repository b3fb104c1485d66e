# SPDX-License-Identifier: GPL-3.0-or-later
"""The transformer: sizes by hand, token dropping, starting as the geometry, and shorter types."""

import argparse
import typing

import pytest
import torch

from timesplat.cli import train_arguments
from timesplat.datagen.sequence import InputError
from timesplat.model.gaussians import FIELDS
from timesplat.model.geometry.lift import lift_geometry
from timesplat.model.geometry.plane_sweep import sweep_geometry
from timesplat.model.inference import geometry_for
from timesplat.model.network import PRESETS, Config, Network, load_matching
from timesplat.model.patches import gather_pixels
from timesplat.model.rasterize.constants import WIDER
from timesplat.model.views import rays

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


@pytest.mark.parametrize("name", ["head", "source", "depth_range", "time", "motion"])
def test_a_word_that_no_network_knows_is_refused(name):
    """Not taken for one of the others; and the command line offers the words that the network knows."""
    with pytest.raises(InputError, match=rf"^{name} papr: .*choose one of \w+, \w+.*\.$"):
        Config(**{name: "papr"})
    parser = argparse.ArgumentParser()
    train_arguments(parser)
    (action,) = (a for a in parser._actions if a.dest == name)
    assert set(action.choices) == set(typing.get_args(typing.get_type_hints(Config)[name]))


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
    equal = torch.exp(torch.tensor(-2.3)) ** 2 * torch.eye(4)  # equal scales: any rotation leaves a sphere …
    equal[:3, :3] += (WIDER * views.pixel) ** 2 * torch.eye(3)  # … widened, for our rasteriser blurs less
    torch.testing.assert_close(S, equal.expand_as(S), atol=1e-6, rtol=1e-4)
    distance = (g.xyz - views.c2w[0, :3, 3])[: 32 * 32].norm(dim=-1)
    torch.testing.assert_close(distance, torch.full_like(distance, 2.3), atol=1e-5, rtol=0)


def test_paper_head_has_the_same_shapes_in_training(views):
    torch.manual_seed(0)
    net = Network(Config(**TINY, head="paper"))
    a, b = net(views), net.eval()(views)
    torch.testing.assert_close(a.covariance4(), b.covariance4())
    torch.testing.assert_close(a.scale.square().sum(-1), b.scale.square().sum(-1))  # the trace


def test_clamps_hold(views):
    torch.manual_seed(0)
    net = Network(Config(**TINY, head="kinematic"))
    net.decode.weight.data *= 1000
    g = net(views)
    assert g.scale.square().max() <= 0.3**2 + (WIDER * views.pixel) ** 2 + 1e-6 and g.sigma_t.max() <= 1.0
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
    base = geometry.gaussians.widened(WIDER * views.pixel)
    assert len(g) == len(base) > 0
    for k in ("xyz", "t", "velocity", "sigma_t", "scale", "rotation", "rgb"):
        torch.testing.assert_close(getattr(g, k), getattr(base, k), rtol=0, atol=1e-6)
    torch.testing.assert_close(g.opacity, base.opacity, rtol=0, atol=1e-4)


def test_untrained_free_gaussians_fill_the_box_and_the_clip(views):
    torch.manual_seed(0)
    g = Network(Config(**TINY, head="paper", free=200)).eval()(views, drop_empty=False)
    assert len(g) == 3 * 32 * 32 + 200
    centre = torch.cat([g.xyz, g.t[:, None]], 1)[-200:]
    assert centre.abs().max() <= 1
    assert (centre.std(0) > 0.4).all() and (centre.mean(0).abs() < 0.3).all()  # evenly spread would be 0.58


@pytest.mark.parametrize("source", ["predicted", "sweep"])
def test_free_gaussians_join_a_trained_network_faintly(views, source):
    torch.manual_seed(0)
    old = Network(Config(**TINY, source=source)).eval()
    new = Network(Config(**TINY, source=source, free=7)).eval()
    load_matching(new, old)
    geometry = sweep_geometry(views) if source == "sweep" else None
    a, b = old(views, geometry), new(views, geometry)
    assert len(b) == len(a) + 7 and (b[: len(a)].xyz - a.xyz).abs().max() < 0.1
    added = b[len(a) :]
    assert (added.opacity < 0.0101).all() and not added.alive().any()
    assert (added.opacity > 2 / 255).all()  # enough to be drawn, and so to learn
    again = Network(Config(**TINY, source=source, free=7)).eval()
    load_matching(again, new)
    assert torch.equal(again(views, geometry).xyz, b.xyz)


def test_another_architecture_is_refused():
    with pytest.raises(InputError, match="has width 32 instead of 64, free 3 instead of 0; train"):
        load_matching(Network(Config(64, 2, 2)), Network(Config(**TINY, free=3)))


@pytest.mark.parametrize("head", ["paper", "kinematic"])
@pytest.mark.parametrize("source", ["predicted", "sweep", "given"])
def test_temporal_alignment_fixes_the_time_alone(views, head, source):
    """The network with one output fewer equals the free one whose output is 0, but for μ_t."""
    torch.manual_seed(0)
    make = {"sweep": sweep_geometry, "given": lift_geometry}.get(source)
    geometry = make(views) if make else None
    aligned = Network(Config(**TINY, head=head, source=source, time="aligned")).eval()
    free = Network(Config(**TINY, head=head, source=source)).eval()
    n = free.config.free_layout.width
    assert aligned.decode.weight.shape[0] == 64 * (n - 1)
    torch.nn.init.normal_(aligned.decode.weight, std=0.1)
    state = aligned.state_dict()
    rows = aligned.decode.weight.detach().unflatten(0, (64, n - 1))
    zero = torch.zeros(64, 1, 32)
    before, after = rows.split([free.config.pixel_layout.slice("t").start, n - 4], 1)
    state["decode.weight"] = torch.cat([before, zero, after], 1).flatten(0, 1)
    free.load_state_dict(state)
    a, b = aligned(views, geometry), free(views, geometry)
    for k in ("xyz", "velocity", "sigma_t", "rgb", "opacity"):
        torch.testing.assert_close(getattr(a, k), getattr(b, k), atol=1e-6, rtol=1e-5)
    if source == "predicted":
        keep = aligned.kept_patches(views)
        own = views.time[:, None].expand(3, 16).flatten()[keep]
        assert torch.equal(a.t, own.repeat_interleave(64))
    else:
        assert torch.equal(a.t, geometry.gaussians.t)


def test_centred_depth_starts_where_the_ray_passes_the_centre(views):
    torch.manual_seed(0)
    net = Network(Config(**TINY, depth_range="centred")).eval()
    net.decode.weight.data *= 1e4  # omega is 0 or 1: the ends of the range
    origin, direction = rays(views.c2w, views.intrinsics, *views.size)
    keep = net.kept_patches(views, drop_empty=False)
    middle = gather_pixels(origin - (origin * direction).sum(-1, keepdim=True) * direction, keep, 8).flatten(0, 1)
    ends = (net(views, drop_empty=False).xyz - middle).norm(dim=-1)
    assert ends.max() < 1.8001 and (ends > 1.79).float().mean() > 0.9
    torch.nn.init.zeros_(net.decode.weight)
    torch.testing.assert_close(net(views, drop_empty=False).xyz, middle, atol=1e-5, rtol=0)


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


def test_checkpointing_changes_no_gradient(views):
    gradients = []
    for checkpointing in (False, True):
        torch.manual_seed(0)
        net = Network(Config(**TINY))
        net.checkpointing = checkpointing
        net(views).xyz.square().sum().backward()
        gradients.append([p.grad for p in net.parameters()])
    for a, b in zip(*gradients, strict=True):
        assert torch.equal(a, b)


def test_odd_image_size_is_refused(spheres):
    with pytest.raises(ValueError, match="multiples of 8"):
        Network(Config(**TINY))(spheres([0], size=30))


@pytest.mark.parametrize("tokens", ["of zero weights", "any"])
@pytest.mark.parametrize(
    ("head", "source"), [("paper", "predicted"), ("kinematic", "predicted"), ("kinematic", "given")]
)
def test_bfloat16_touches_the_transformer_alone(spheres, monkeypatch, head, source, tokens):
    """Whatever the transformer says, its Gaussians are those in float32: no ray, head or conversion is in bfloat16."""
    views = spheres(list(range(4)), size=32)
    torch.manual_seed(0)
    net = Network(Config(**TINY, head=head, source=source)).eval()
    if tokens == "any":
        torch.nn.init.normal_(net.decode.weight, std=0.2)
        found = torch.randn(int(net.kept_patches(views).sum()), TINY["width"])
        monkeypatch.setattr(net, "transform", lambda x: {"patches": found})
    else:
        for weights in net.parameters():
            torch.nn.init.zeros_(weights)
    geometry, same = geometry_for(source, views), {"rtol": 0, "atol": 0, "equal_nan": True}  # zeros are no rotation
    with torch.no_grad():
        exact = net(views, geometry)
        with torch.autocast("cpu", torch.bfloat16):
            short = net(views, geometry)
    for k in FIELDS:
        assert getattr(short, k).dtype == torch.float32
        torch.testing.assert_close(getattr(short, k), getattr(exact, k), **same)
    torch.testing.assert_close(short.covariance3(), exact.covariance3(), **same)
    if tokens == "any":
        assert torch.linalg.eigvalsh(short.covariance3()).min() > 0


def test_bfloat16_is_used_inside_of_the_transformer(views):
    net, kinds = Network(Config(**TINY)).eval(), []
    net.blocks[0].qkv.register_forward_hook(lambda module, inputs, output: kinds.append(output.dtype))
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        net(views)
    assert kinds == [torch.bfloat16]


def test_weights_have_the_names_of_the_checkpoints():
    net = Network(Config(**TINY, free=3, motion="hexplane"))
    names = {k.split(".")[0] for k in net.state_dict()}
    expected = {"embed", "norm_in", "blocks", "norm_out", "decode", "free_tokens", "decode_free", "plane_tokens"}
    assert names == expected | {"decode_planes", "deform"}
