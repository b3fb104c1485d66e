"""Groups of clips, and how likely each is drawn."""

import pytest

from timesplat.datagen.sequence import InputError
from timesplat.model.training.clip_groups import group_of, group_probabilities, parse_mix


def test_groups_go_by_motion_and_displacement():
    def group(motion, displaced="False", frames="24"):
        return group_of({"motion": str(motion), "displaced": displaced, "frames": frames})

    found = [group(x) for x in (0.0, 0.1, 0.3, 0.6, float("nan"))]
    assert found == ["3d", "4d", "hq4d", "4d", "4d"]
    assert group(0.3, "True") == group(float("nan"), frames="1") == "3d"


def test_a_mix_is_a_weight_for_each_group():
    assert parse_mix("200:50:1") == {"hq4d": 200, "4d": 50, "3d": 1} and parse_mix("uniform") is None


@pytest.mark.parametrize("wrong", ["2:1", "a:b:c", "-1:2:3", "nan:1:1"])
def test_what_is_no_mix_is_refused(wrong):
    with pytest.raises(InputError, match="mix"):
        parse_mix(wrong)


def test_groups_without_clips_are_left_out():
    counts = {"hq4d": 3, "4d": 0, "3d": 1}
    assert group_probabilities("3:50:1", counts).tolist() == [0.75, 0, 0.25]
    assert group_probabilities("uniform", counts).tolist() == [0.75, 0, 0.25]
    with pytest.raises(InputError, match="none of the clips"):
        group_probabilities("0:1:0", counts)
