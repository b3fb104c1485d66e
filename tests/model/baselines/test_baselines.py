"""The baselines: what each sees of the input, and that optimisation earns its seconds."""

import pytest
import torch

from timesplat.datagen.sequence import InputError
from timesplat.evaluation.image_quality import psnr
from timesplat.model.baselines.four_dgs import four_dgs
from timesplat.model.baselines.gs_lrm import all_in, per_frame
from timesplat.model.baselines.shape_of_motion import Motion, som
from timesplat.model.network import Config, Network
from timesplat.model.rasterize import render
from timesplat.model.reconstruct import reconstruct_views, save_network


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
    scene = reconstruct_views(views, "gs-lrm-frame", checkpoint=static)
    first = reconstruct_views(views[:2], "gs-lrm-frame", checkpoint=static)
    last = reconstruct_views(views[3:], "gs-lrm-all", checkpoint=static)
    assert len(scene) > len(first) + len(last) and len(first) > 100
    for t, alone in ((-1.0, first.at(0.7)), (0.9, last)):
        torch.testing.assert_close(scene.at(t).xyz, alone.xyz)
        torch.testing.assert_close(scene.at(t).opacity, alone.opacity)
        torch.testing.assert_close(scene.at(t).rgb, alone.rgb)


@torch.inference_mode()
def test_collapsed_times_do_not_matter(spheres, static):
    views = spheres([0, 8, 16], size=32)
    a = reconstruct_views(views, "gs-lrm-all", checkpoint=static)
    views.time = views.time.flip(0)
    b = reconstruct_views(views, "gs-lrm-all", checkpoint=static)
    torch.testing.assert_close(a.xyz, b.xyz)
    torch.testing.assert_close(a.position(torch.tensor(-1.0)), a.position(torch.tensor(1.0)))
    assert a.marginal(torch.tensor(1.0)).min() > 0.999


def paint(views):
    """A stand-in for the network: one round blob in the colour of the first view's first foreground pixel."""
    from timesplat.model.baselines.visual_hull import white

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


@pytest.fixture(scope="module")
def moving(spheres):
    """Input views of the moving spheres, and held-out ones."""
    frames = list(range(24))
    return spheres(frames, size=32), spheres(frames[3::6], [(45, 20), (200, -10), (120, 30), (300, 10)], size=32)


def quality(scene, views):
    scene = scene[scene.alive()]
    rgb, _ = render(scene, views.c2w, views.intrinsics, views.time, *views.size, inference=True)
    return float(psnr(rgb, views.over(1.0)).mean())


def test_4dgs_learns_from_random_points(moving):
    inputs, held_out = moving
    with torch.inference_mode():
        white, start = quality(reconstruct_views(inputs, "white"), held_out), four_dgs(inputs, steps=0)
        g = four_dgs(inputs, steps=120)
    assert len(start) == 8000 and quality(start, held_out) < white
    assert quality(g, inputs) > white + 8 and quality(g, held_out) > white + 4
    assert not g.xyz.requires_grad


def test_a_number_of_steps_gives_the_same_on_every_run_and_seconds_end(moving, steady_clock):
    views = moving[0]
    a, b = four_dgs(views, steps=6), four_dgs(views, steps=6)
    torch.testing.assert_close(a.xyz, b.xyz, rtol=0, atol=0)
    torch.testing.assert_close(a.opacity, b.opacity, rtol=0, atol=0)
    told = []
    reconstruct_views(views, "4dgs", seconds=0.3, progress=lambda fraction, text: told.append((fraction, text)))
    assert told == sorted(told) and told[-1] == (1, "4dgs, step 29")


def test_som_follows_what_moves(spheres):
    frames = [f for f in range(0, 24, 3) for _ in range(3)]
    inputs = spheres(frames, [(120 * k + 15 * f, 10) for f in range(0, 24, 3) for k in range(3)], size=32)
    with torch.inference_mode():
        start, scene = som(inputs, steps=0), som(inputs, steps=100)
    assert quality(scene, inputs) > quality(start, inputs) + 5
    # Gaussians that are red belong to the first sphere, whose centre moves (0.46, 0.23, 0) over the clip.
    red = (start.gaussians.rgb[:, 0] > 0.5) & (start.gaussians.rgb[:, 1] < 0.4)
    way = (scene.at(1.0).xyz - scene.at(-1.0).xyz)[red].mean(0)
    assert red.sum() > 100
    torch.testing.assert_close(way, torch.tensor([0.46, 0.23, 0.0]), atol=0.15, rtol=0)


def test_motion_moves_rigidly_and_stands_still_beyond_its_ends(spheres):
    views = spheres([4, 12, 20], size=24)
    scene = som(views, steps=0)
    turn = torch.tensor([0.5**0.5, 0, 0, 0.5**0.5])  # a quarter about z
    bases = torch.tensor([1.0, 0, 0, 0, 0, 0, 0]).repeat(3, scene.bases.shape[1], 1)
    bases[2, :, :4], bases[2, :, 4:] = turn, torch.tensor([0.1, 0.2, 0.3])
    scene = Motion(scene.gaussians, scene.blend, scene.moments, bases)
    first, middle, last = (scene.at(float(t)) for t in views.time)
    x, y, z = first.xyz.unbind(-1)
    torch.testing.assert_close(last.xyz, torch.stack([-y + 0.1, x + 0.2, z + 0.3], -1), atol=1e-5, rtol=0)
    R = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    torch.testing.assert_close(last.covariance3(), R @ first.covariance3() @ R.T, atol=1e-6, rtol=1e-4)
    torch.testing.assert_close(middle.xyz, first.xyz)
    torch.testing.assert_close(scene.at(1.0).xyz, last.xyz)
    half = scene[scene.alive()][::2].to("cpu")
    assert len(half) == (len(scene) + 1) // 2 and len(half.at(0.3)) == len(half)
    with pytest.raises(InputError, match="do not move on straight lines"):
        scene.to_asset(None)
    views.alpha[:] = 0
    assert len(som(views, steps=1)) == 0
