# SPDX-License-Identifier: GPL-3.0-or-later
"""GS-LRM on moving things: each frame alone, and all views as of one moment."""

import pytest
import torch

from timesplat.datagen.sequence import InputError
from timesplat.model.baselines.gs_lrm import all_in, per_frame
from timesplat.model.baselines.visual_hull import white
from timesplat.model.checkpoints_io import save_network
from timesplat.model.methods import ReconstructOptions
from timesplat.model.network import Config, Network
from timesplat.model.rasterize import render
from timesplat.model.reconstruct import reconstruct_views


@pytest.fixture(scope="module", params=["sweep", "predicted"])
def static(request, tmp_path_factory):
    """A small network's checkpoint; with random outputs, so that everything it sees shows."""
    torch.manual_seed(0)
    network = Network(Config(width=32, depth=1, heads=2, source=request.param))
    torch.nn.init.normal_(network.decode.weight, std=0.05)
    path = tmp_path_factory.mktemp("static") / "static.safetensors"
    save_network(path, network)
    return path


@torch.inference_mode()
def test_frames_know_nothing_of_each_other(spheres, static):
    views = spheres([0, 0, 6, 23], [(0, 0), (120, 20), (90, 0), (200, 0)], size=32)
    scene = reconstruct_views(views, "gs-lrm-frame", ReconstructOptions(checkpoint=static))
    first = reconstruct_views(views[:2], "gs-lrm-frame", ReconstructOptions(checkpoint=static))
    last = reconstruct_views(views[3:], "gs-lrm-all", ReconstructOptions(checkpoint=static))
    assert len(scene) > len(first) + len(last) and len(first) > 100
    for t, alone in ((-1.0, first.at(0.7)), (0.9, last)):
        torch.testing.assert_close(scene.at(t).xyz, alone.xyz)
        torch.testing.assert_close(scene.at(t).opacity, alone.opacity)
        torch.testing.assert_close(scene.at(t).rgb, alone.rgb)


@torch.inference_mode()
def test_collapsed_times_do_not_matter(spheres, static):
    views = spheres([0, 8, 16], size=32)
    a = reconstruct_views(views, "gs-lrm-all", ReconstructOptions(checkpoint=static))
    views.time = views.time.flip(0)
    b = reconstruct_views(views, "gs-lrm-all", ReconstructOptions(checkpoint=static))
    torch.testing.assert_close(a.xyz, b.xyz)
    torch.testing.assert_close(a.position(torch.tensor(-1.0)), a.position(torch.tensor(1.0)))
    assert a.marginal(torch.tensor(1.0)).min() > 0.999


def paint(views):
    """A stand-in for the network: one round blob in the colour of the first view's first foreground pixel."""
    assert (views.time == 0).all()
    g = white(views).map(lambda x: torch.ones(1, *x.shape[1:]))
    g.xyz, g.velocity, g.t, g.scale = 0 * g.xyz, 0 * g.velocity, 0 * g.t, 0.2 * g.scale
    g.rgb = views.rgb[0][views.alpha[0] > 0.5][:1]
    g.rotation = torch.tensor([[1.0, 0, 0, 0]])
    return g


def test_the_nearest_moment_that_shows_the_object_is_shown(spheres):
    views = spheres([0, 6, 12, 23], size=32)
    views.rgb = torch.linspace(0.2, 0.8, 4)[:, None, None, None].expand_as(views.rgb).clone()
    views.alpha[1] = 0  # nothing to be seen at frame 6
    scene = per_frame(views, paint)
    scene = scene[scene.alive()].to("cpu")
    assert len(scene) == 3
    time = torch.tensor([-1.0, views.time[1], 0.2, 0.9])
    camera = [x[:1].expand(4, *x.shape[1:]) for x in (views.c2w, views.intrinsics)]
    rgb, _ = render(scene, *camera, time, 32, 32, inference=True)
    centre = rgb[:, 15:17, 15:17, 0].mean((1, 2))
    nearest = [0, 0 if views.time[1] + 1 <= views.time[2] - views.time[1] else 2, 2, 3]
    torch.testing.assert_close(centre, views.rgb[nearest, 0, 0, 0], atol=0.05, rtol=0)
    with pytest.raises(InputError, match="is no 4D Gaussian asset"):
        scene.to_asset(None)


def test_per_frame_of_nothing_and_all_in_of_one(spheres):
    views = spheres([3, 5], size=16)
    g = all_in(views, paint)
    assert len(g) == 1 and g.alive().all()
    views.alpha[:] = 0
    assert len(per_frame(views, paint)) == len(per_frame(views, paint).at(0.3)) == 0
