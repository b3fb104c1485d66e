"""Training data: what comes back is what was rendered, and samples are what they are said to be."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from timesplat.datagen.sequence import InputError, read_sequence
from timesplat.model.training.dataset import Clips, group_of, motion_measure, parse_mix, shrink
from timesplat.model.training.view_sampling import Layout, choose, choose_inputs
from timesplat.model.views import load_views

NAMES = ["back", "elevated", "front", "left", "orbit", "right"]


@pytest.fixture
def layout():
    """The default rig: six cameras at each of 24 frames."""
    return Layout(np.repeat(np.arange(24), 6), np.tile(np.arange(6), 24), NAMES, "thing.glb")


def test_packed_views_are_the_rendered_ones(sphere_folder, tmp_path):
    seq = read_sequence(sphere_folder)
    clips = Clips([sphere_folder.parent], tmp_path)
    sample = clips.sample(np.random.default_rng(0), targets=2)
    whole = load_views(seq, range(len(seq.views)), with_depth=True)
    for part in (sample.inputs, sample.targets):
        for i in range(len(part)):
            n = next(
                k for k in range(len(whole)) if torch.equal(whole.c2w[k], part.c2w[i]) and whole.time[k] == part.time[i]
            )
            assert torch.equal(whole.rgb[n], part.rgb[i]) and torch.equal(whole.alpha[n], part.alpha[i])
            if part is sample.targets:
                assert part.depth is None and part.flow is None
                continue
            on = whole.alpha[n] > 0
            torch.testing.assert_close(part.depth[i][on], whole.depth[n][on], rtol=1e-3, atol=0)
            torch.testing.assert_close(part.flow[i][on], whole.flow[n][on], rtol=1e-3, atol=1e-3)
    assert len(list(tmp_path.glob("*.safetensors"))) == 1
    with pytest.raises(InputError, match="no Sequence"):
        Clips([tmp_path / "nothing"], tmp_path)


def test_pictures_alone_are_packed_where_there_are_no_passes(sphere_folder, pictures, tmp_path):
    with pytest.raises(InputError, match=r"pictures: .*depth.*render it with passes, or .*--source sweep or predicted"):
        Clips([pictures], tmp_path)
    assert not list(tmp_path.glob("*.safetensors"))
    clips = Clips([pictures, sphere_folder], tmp_path, passes=False)
    inputs = [clips.sample(np.random.default_rng(seed), 2).inputs for seed in range(9)]
    assert all(x.depth is None and x.flow is None and x.alpha.any() for x in inputs)
    whole = Clips([sphere_folder], tmp_path / "whole", passes=True)
    assert whole.paths[0].name == clips.paths[1].name  # what has passes is packed with them in any case
    with pytest.raises(InputError, match="pictures: "):  # also once it is packed without
        Clips([pictures], tmp_path)
    assert Clips([pictures], tmp_path, passes=False).paths == clips.paths[:1]


@pytest.mark.parametrize("seed", range(20))
def test_inputs_are_one_view_a_frame_or_two_at_even_ones(seed):
    frame, camera = np.repeat(np.arange(24), 6), np.tile(np.arange(6), 24)
    chosen = choose_inputs(np.random.default_rng(seed), frame, camera, NAMES, 24)
    counts = np.bincount(frame[chosen], minlength=24)
    assert len(set(chosen.tolist())) == 24
    assert (counts == 1).all() or ((counts[::2] == 2).all() and (counts[1::2] == 0).all())
    few = choose_inputs(np.random.default_rng(seed), frame, camera, NAMES, 7)
    assert len(few) == 7 and (np.diff(frame[few]) >= 0).all()


def test_targets_of_setups_are_other_views(layout):
    inputs, targets = choose("setups", np.random.default_rng(0), layout, 24, 8)
    assert len(inputs) == 24 and len(set(targets)) == 8 and not set(inputs) & set(targets)
    few = Layout(np.arange(6), np.zeros(6, int), ["front"])
    inputs, targets = choose("setups", np.random.default_rng(0), few, 24, 8)
    assert len(targets) > 0  # where every view is an input, these are supervised


def test_the_papers_sample_is_twelve_and_twentyfour_of_thirtysix(layout):
    """Drawn independently, they share eight views on average."""
    shared = []
    for seed in range(60):
        inputs, targets = choose("paper", np.random.default_rng(seed), layout, 12, 24)
        assert len(set(inputs)) == 12 and len(set(targets)) == 24 and len(set(inputs) | set(targets)) <= 36
        assert (np.diff(layout.frame[inputs]) >= 0).all()
        shared.append(len(set(inputs) & set(targets)))
    assert np.mean(shared) == pytest.approx(8, abs=0.6)


def test_video_is_four_canonical_views_and_the_front(layout):
    inputs, targets = choose("video", np.random.default_rng(0), layout, 27, 8)
    cameras = [NAMES[layout.camera[i]] for i in inputs]
    assert len(inputs) == 27 and sorted(cameras[:4]) == ["back", "front", "left", "right"]
    assert set(cameras[4:]) == {"front"} and layout.frame[inputs[4:]].tolist() == list(range(1, 24))
    assert len(set(targets)) == 8
    inputs, _ = choose("video", np.random.default_rng(0), layout, 12, 8)
    assert len(inputs) == 12 and layout.frame[inputs[-1]] == 23
    with pytest.raises(InputError, match="front"):
        choose("video", np.random.default_rng(0), Layout(np.arange(6), np.zeros(6, int), ["orbit"], "x.glb"), 27, 8)


def test_static_samples_are_one_frame_at_time_zero(layout, sphere_folder, tmp_path):
    for seed in range(5):
        inputs, targets = choose("static", np.random.default_rng(seed), layout, 4, 4)
        assert len(set(inputs)) == len(set(targets)) == 4
        assert len(set(layout.frame[np.concatenate([inputs, targets])])) == 1
    clips = Clips([sphere_folder], tmp_path, sampling="static")
    sample = clips.sample(np.random.default_rng(0), targets=2, views=2)
    for part in (sample.inputs, sample.targets):
        assert len(part) == 2 and not part.time.any()
    assert not sample.inputs.flow.any()


def test_shrinking_averages_light_and_keeps_the_nearest_surface(spheres):
    views = spheres([0, 5], size=32)
    half = shrink(views, 2)
    assert half.size == (16, 16)
    blocks = views.over(0.0).reshape(2, 16, 2, 16, 2, 3).mean((2, 4))
    torch.testing.assert_close(half.over(0.0), blocks, atol=1e-6, rtol=0)
    exact = spheres([0, 5], size=16)
    both = torch.isfinite(exact.depth) & torch.isfinite(half.depth)
    assert (half.depth - exact.depth)[both].abs().median() < 0.02
    assert (half.flow - exact.flow)[both].abs().median() < 0.02
    torch.testing.assert_close(half.intrinsics, exact.intrinsics)
    blind = shrink(replace(views, depth=None, flow=None), 2)
    assert blind.depth is None and torch.equal(blind.rgb, half.rgb)


def clip(distance: float) -> dict:
    """A packed clip of a white pixel on black that gets `distance` darker over four frames; 100 empty pixels."""
    rgba = torch.zeros(4, 1, 101, 5, dtype=torch.uint8)
    rgba[:, 0, 0, 3] = 255
    rgba[:, 0, 0, :3] = (255 * (1 - distance * torch.linspace(0, 1, 4)))[:, None].round().to(torch.uint8)
    return {"rgba": rgba, "camera": torch.zeros(4, dtype=torch.long)}


def test_motion_is_the_greatest_distance_between_frames():
    assert motion_measure(clip(0.0), ["front"]) == 0
    assert motion_measure(clip(0.4), ["front"]) == pytest.approx(0.4, abs=0.01)
    assert np.isnan(motion_measure(clip(0.4), ["orbit"]))


def test_groups_go_by_motion_and_displacement():
    def group(motion, displaced="False", frames="24"):
        return group_of({"motion": str(motion), "displaced": displaced, "frames": frames})

    found = [group(x) for x in (0.0, 0.1, 0.3, 0.6, float("nan"))]
    assert found == ["3d", "4d", "hq4d", "4d", "4d"]
    assert group(0.3, "True") == group(float("nan"), frames="1") == "3d"


def test_groups_are_drawn_by_their_weights(sphere_folder, tmp_path):
    clips = Clips([sphere_folder], tmp_path, mix="200:50:1")
    assert clips.weights.tolist() == [0, 1, 0]  # only what exists
    (path,) = clips.paths
    clips.groups, clips.weights = {"hq4d": [path], "4d": [], "3d": [path]}, np.array([0.75, 0, 0.25])
    assert clips.sample(np.random.default_rng(0), 2).name == "spheres"
    assert parse_mix("200:50:1") == {"hq4d": 200, "4d": 50, "3d": 1} and parse_mix("uniform") is None
    for wrong in ("2:1", "a:b:c", "-1:2:3", "nan:1:1"):
        with pytest.raises(InputError, match="mix"):
            parse_mix(wrong)
    with pytest.raises(InputError, match="none of the clips"):
        Clips([sphere_folder], tmp_path, mix="1:0:0")
