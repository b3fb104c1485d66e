"""Which views a sample takes: counts, order and overlap of every sampling."""

import numpy as np
import pytest

from timesplat.datagen.sequence import InputError
from timesplat.model.training.view_sampling import ClipLayout, sample_setup_inputs, sample_views

NAMES = ["back", "elevated", "front", "left", "orbit", "right"]


@pytest.fixture
def layout():
    """The default rig: six cameras at each of 24 frames."""
    return ClipLayout(np.repeat(np.arange(24), 6), np.tile(np.arange(6), 24), NAMES, "thing.glb")


@pytest.mark.parametrize("seed", range(20))
def test_inputs_are_one_view_a_frame_or_two_at_even_ones(layout, seed):
    chosen = sample_setup_inputs(np.random.default_rng(seed), layout, 24)
    counts = np.bincount(layout.frame[chosen], minlength=24)
    assert len(set(chosen.tolist())) == 24
    assert (counts == 1).all() or ((counts[::2] == 2).all() and (counts[1::2] == 0).all())
    few = sample_setup_inputs(np.random.default_rng(seed), layout, 7)
    assert len(few) == 7 and (np.diff(layout.frame[few]) >= 0).all()


def test_targets_of_setups_are_other_views(layout):
    inputs, targets = sample_views("setups", np.random.default_rng(0), layout, 24, 8)
    assert len(inputs) == 24 and len(set(targets)) == 8 and not set(inputs) & set(targets)
    few = ClipLayout(np.arange(6), np.zeros(6, int), ["front"])
    inputs, targets = sample_views("setups", np.random.default_rng(0), few, 24, 8)
    assert len(targets) > 0  # where every view is an input, these are supervised


def test_the_papers_sample_is_twelve_and_twentyfour_of_thirtysix(layout):
    """Drawn independently, they share eight views on average."""
    shared = []
    for seed in range(60):
        inputs, targets = sample_views("paper", np.random.default_rng(seed), layout, 12, 24)
        assert len(set(inputs)) == 12 and len(set(targets)) == 24 and len(set(inputs) | set(targets)) <= 36
        assert (np.diff(layout.frame[inputs]) >= 0).all()
        shared.append(len(set(inputs) & set(targets)))
    assert np.mean(shared) == pytest.approx(8, abs=0.6)


def test_video_is_four_canonical_views_and_the_front(layout):
    inputs, targets = sample_views("video", np.random.default_rng(0), layout, 27, 8)
    cameras = [NAMES[layout.camera[i]] for i in inputs]
    assert len(inputs) == 27 and sorted(cameras[:4]) == ["back", "front", "left", "right"]
    assert set(cameras[4:]) == {"front"} and layout.frame[inputs[4:]].tolist() == list(range(1, 24))
    assert len(set(targets)) == 8
    inputs, _ = sample_views("video", np.random.default_rng(0), layout, 12, 8)
    assert len(inputs) == 12 and layout.frame[inputs[-1]] == 23
    with pytest.raises(InputError, match="front"):
        sample_views(
            "video", np.random.default_rng(0), ClipLayout(np.arange(6), np.zeros(6, int), ["orbit"], "x.glb"), 27, 8
        )


def test_static_is_one_frame(layout):
    for seed in range(5):
        inputs, targets = sample_views("static", np.random.default_rng(seed), layout, 4, 4)
        assert len(set(inputs)) == len(set(targets)) == 4
        assert len(set(layout.frame[np.concatenate([inputs, targets])])) == 1
