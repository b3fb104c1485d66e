"""Which views go in and which are scored, on the evaluation rig and on the small ones; no images needed."""

import numpy as np
import pytest

from timesplat.datagen import rigs
from timesplat.datagen.sequence import InputError, Sequence, View, read_sequence
from timesplat.evaluation import protocol


def sequence(rig="evaluation", frames=24, first=3):
    span = range(first, first + frames)
    shots = rigs.RIGS[rig](span, 7) + rigs.targets(span, 7)
    views = [View(s.frame, s.camera, s.rig, s.c2w, 1, 1, 1, 1) for s in shots]
    return Sequence(8, 8, 24, first, first + frames - 1, views=views)


COUNTS = {"alternating": 24, "interpolation": 24, "rotating": 24, "random": 24, "video": 27, "canonical": 96}


@pytest.mark.parametrize("setup", COUNTS)
def test_setups_are_those_of_the_rigs(setup):
    seq = sequence()
    chosen = protocol.inputs(seq, setup)
    assert len(chosen) == len(set(chosen)) == COUNTS[setup]
    made = {**rigs.SETUPS, "canonical": rigs.canonical}[setup](range(3, 27), 7)
    if setup == "random":
        assert {(seq.views[i].frame, seq.views[i].camera) for i in chosen} == {(f, "random0") for f in range(3, 27)}
    else:
        for i, shot in zip(chosen, made, strict=True):
            assert seq.views[i].frame == shot.frame and np.allclose(seq.views[i].c2w, shot.c2w)


@pytest.mark.parametrize("setup", ["alternating", "interpolation", "rotating", "random", "video"])
def test_the_small_rigs_give_the_same(setup):
    small = sequence(setup)
    chosen = protocol.inputs(small, setup)
    assert [small.views[i].rig for i in chosen] == [setup] * COUNTS[setup]
    scored = protocol.targets(small)
    assert [small.views[i].rig for i in scored] == ["target"] * 24
    assert protocol.novel(small, chosen, scored) == scored


def test_the_paper_scores_five_views_a_frame_and_novel_ones_are_not_inputs():
    seq = sequence()
    scored = protocol.targets(seq)
    assert len(scored) == 120 and [seq.views[i].frame for i in scored] == sorted(seq.views[i].frame for i in scored)
    fresh = {s: protocol.novel(seq, protocol.inputs(seq, s), scored) for s in COUNTS}
    # The rotating cameras start in front and end at the back, where canonical views are.
    expected = {"alternating": 96, "interpolation": 96, "rotating": 118, "random": 120, "video": 93, "canonical": 24}
    assert {s: len(f) for s, f in fresh.items()} == expected
    assert len(protocol.targets(seq, stride=4)) == 30
    assert {seq.views[i].frame for i in protocol.targets(seq, stride=4)} == set(range(3, 27, 4))


def test_moments_between_frames_are_scored_with_the_frame_before():
    seq = sequence("alternating", frames=8, first=0)
    for i in seq.select(rig="target"):
        seq.views[i].frame += 0.5
    assert len(protocol.targets(seq)) == 8
    assert [seq.views[i].frame for i in protocol.targets(seq, stride=4)] == [0.5, 4.5]


@pytest.mark.parametrize("count", [4, 8, 12, 24, 36, 48, 96])
def test_spread_views_are_even(count):
    chosen = protocol.inputs(seq := sequence(), f"views-{count}")
    assert len(set(chosen)) == count
    per_frame = np.bincount([seq.views[i].frame - 3 for i in chosen], minlength=24)
    assert per_frame.max() - per_frame.min() <= 1 and {seq.views[i].rig for i in chosen} == {"random"}
    assert protocol.novel(seq, chosen, protocol.targets(seq)) == protocol.targets(seq)
    if count == 24:
        assert chosen == protocol.inputs(seq, "random")


def test_views_per_frame():
    seq = sequence()
    assert protocol.inputs(seq, "random-1") == protocol.inputs(seq, "random")
    assert len(protocol.inputs(seq, "random-3")) == 72


def test_refusals():
    for setup in ("sideways", "random-5", "views-0", "views-x"):
        with pytest.raises(InputError, match="no such setup"):
            protocol.inputs(sequence(), setup)
    with pytest.raises(InputError, match="1 to 96"):
        protocol.inputs(sequence(), "views-97")
    with pytest.raises(InputError, match="--rig evaluation"):
        protocol.inputs(sequence("alternating"), "rotating")
    with pytest.raises(InputError, match="--targets 1"):
        protocol.targets(Sequence(8, 8, 24, 0, 0, views=[View(0, "a", "orbit", np.eye(4), 1, 1, 1, 1)]))
    with pytest.raises(InputError, match="--stride 0"):
        protocol.targets(sequence(), 0)


def test_chosen_frames_cycle_through_the_canonical_cameras(evaluation_folder):
    seq = read_sequence(evaluation_folder)
    views = [seq.views[i] for i in protocol.every_nth(seq, 4)]
    assert [v.frame for v in views] == list(range(0, 24, 4))
    assert [v.camera for v in views] == ["front", "left", "back", "right", "front", "left"]
