"""Deferred backpropagation through the rasteriser: the gradients of one graph, in less memory."""

import tracemalloc
from dataclasses import replace

import pytest
import torch

from timesplat.model.gaussians import FIELDS
from timesplat.model.geometry.lift import lift
from timesplat.model.rasterize import render
from timesplat.model.training.deferred import DetachedScene
from timesplat.model.training.losses import photometric_loss


def test_deferred_backpropagation_is_exact_and_keeps_less(spheres):
    """Against one graph through all views: the same gradients in half the memory or less."""
    base = lift(spheres([0, 6, 12, 18], size=48))
    targets = spheres(list(range(12)), [(30 * i, 10) for i in range(12)], size=48)
    background = torch.tensor([1.0, 0.5, 0.2])

    def loss(rgb, alpha, few):
        return photometric_loss(rgb, alpha, few, background)

    def network():
        leaves = base.map(lambda x: x.detach().clone().requires_grad_())
        return leaves, replace(leaves, scale=leaves.scale * 1.5, rgb=leaves.rgb * 0.5, xyz=leaves.xyz.tanh())

    def whole():
        leaves, g = network()
        height, width = targets.size
        pictures = render(g, targets.c2w, targets.intrinsics, targets.time, width, height, background=background)
        total = loss(*pictures, targets) + 0.1 * g.opacity.mean()
        total.backward()
        return leaves, float(total.detach())

    def deferred(chunk):
        leaves, g = network()
        scene = DetachedScene(g)
        total, _ = scene.backward_views(targets, background, loss, chunk)
        scene_loss = 0.1 * g.opacity.mean()
        scene.backward_network(1.0, scene_loss)
        return leaves, total + float(scene_loss.detach())

    def measured(f, *args):
        tracemalloc.start()
        found = f(*args)
        peak = tracemalloc.get_traced_memory()[1]  # numpy's arrays: all that the rasteriser keeps
        tracemalloc.stop()
        return *found, peak

    whole(), deferred(1)  # both compile and import, which is not to be measured
    reference, total, peak = measured(whole)
    for chunk in (1, 5, 12):
        leaves, other, less = measured(deferred, chunk)
        assert other == pytest.approx(total, rel=1e-5)
        for k in FIELDS:
            a, b = getattr(reference, k).grad, getattr(leaves, k).grad
            assert (a - b).norm() <= 1e-4 * a.norm(), k
        if chunk == 1:
            assert less < peak / 2


def test_what_is_not_finite_is_seen(spheres):
    g = lift(spheres([0], size=16))
    assert DetachedScene(g).is_finite()
    g.xyz[0, 0] = float("nan")
    assert not DetachedScene(g).is_finite()
