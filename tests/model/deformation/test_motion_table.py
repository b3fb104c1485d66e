# SPDX-License-Identifier: GPL-3.0-or-later
"""The table of motion: at rest nothing moves, what all places do everything does, and levels add up."""

import pytest
import torch

from timesplat.model.deformation.motion_table import MotionTable, spread_points


def a_table(count=700, several=True):
    g = torch.Generator().manual_seed(0)
    points = torch.rand(count, 3, generator=g)
    return MotionTable.around(points, 10, several, g), points


def test_at_rest_nothing_moves():
    table, points = a_table()
    place, turn = table.pose(table.zeros(), table.weights(points), points, 0.3)
    assert torch.equal(place, points) and torch.equal(turn, torch.tensor([1.0, 0, 0, 0]).expand(700, 4))


def test_levels_add_up():
    table, points = a_table()
    values = table.zeros()
    assert len(table.levels) == 5
    values[..., 0], values[..., 5] = 0.1, 0.02
    place, turn = table.pose(values, table.weights(points), points, -0.4)
    assert torch.allclose(place, points + torch.tensor([0.5, 0, 0]), atol=1e-6)
    assert torch.allclose(2 * torch.atan2(turn[:, 3], turn[:, 0]), torch.tensor(0.1), atol=1e-4)


def test_what_a_place_does_is_done_near_it_then():
    table, points = a_table()
    values = table.zeros()
    place = sum(map(len, table.levels[:4])) + 7
    values[2, place, 1] = 1.0
    there = table.levels[4][7:8]
    weights = table.weights(there)
    then, later = (table.pose(values, weights, there, t)[0] - there for t in (float(table.moments[2]), 1.0))
    assert then[0, 1] > 10 * later[0, 1].abs() and then[0, 0] == 0
    far = points[(points - there).norm(dim=-1).argmax()][None]
    assert (table.pose(values, table.weights(far), far, float(table.moments[2]))[0] - far).abs().max() < 1e-3


def test_motion_stays_about_as_it_is_when_moments_count_over_a_shorter_time_and_may_be_faster_then():
    table, points = a_table()
    weights, values = table.weights(points), table.zeros()
    wave = torch.sin(2 * table.moments)
    values[..., 0] = wave[:, None] / len(table.levels)

    def moved():
        return torch.stack([table.pose(values, weights, points, t)[0] - points for t in (-1.0, -0.37, 0.2, 1.0)])

    before = moved()
    table.sharpen(values, 0.7)
    assert (moved() - before).abs().max() < 0.05 * before.abs().max()
    values.zero_()
    values[5, :, 0] = 1.0
    peak = [float((table.pose(values, weights, points[:1], float(table.moments[5]))[0] - points[:1])[0, 0])]
    table.width = 1.5
    peak.append(float((table.pose(values, weights, points[:1], float(table.moments[5]))[0] - points[:1])[0, 0]))
    assert peak[0] > 1.5 * peak[1]


@pytest.mark.parametrize("several", [True, False])
def test_beyond_what_is_known_all_goes_straight_on(several):
    table, _ = a_table(several=several)
    count, values = len(table.moments), table.zeros()
    straight = table.moments[:, None, None] * torch.arange(1.0, 7.0) + 0.3 + values[:count]
    values[:count] = straight
    values[:4], values[count - 4 : count] = 7.0, 7.0
    table.carry_on(values, 4, True, 1.0)
    assert torch.allclose(values[: count - 4], straight[: count - 4], atol=1e-6)
    assert (values[count - 4 : count] == 7).all()
    table.carry_on(values, 4, False, 0.5)
    slower = (straight[-4:] + straight[-5]) / 2
    assert torch.allclose(values[count - 4 : count], slower, atol=1e-6) and not values[count:].any()


def test_spread_points_lie_apart():
    _, points = a_table()
    g = torch.Generator().manual_seed(1)
    chosen = spread_points(points, 20, g)
    random = points[:20]
    nearest = [float((torch.cdist(p, p) + 9 * torch.eye(20)).min()) for p in (chosen, random)]
    assert nearest[0] > 2 * nearest[1]
    assert len(spread_points(points[:5], 20, g)) == 5


def test_where_views_are_few_a_slow_part_is_added():
    table, points = a_table(several=False)
    assert [len(places) for places in table.levels] == [1, 12, 48, 192, 600] and len(table.slow) == 5
    weights, values = table.weights(points), table.zeros()
    assert values.shape == (len(table.moments) + 5, 853, 6)
    values[len(table.moments) :, :, 0] = 0.1
    place, _ = table.pose(values, weights, points, 0.7)
    assert torch.allclose(place, points + torch.tensor([0.5, 0, 0]), atol=1e-6)
    values.zero_()
    values[len(table.moments) + 2] = 1.0  # of the slow part the middle one, which counts long
    values[len(table.moments) // 2] = 1.0  # of the other, which does not
    values[..., 1:] = 0
    near, far = (float((table.pose(values, weights, points[:1], t)[0] - points[:1])[0, 0]) for t in (0.0, 0.9))
    assert near > 1.5 and 0.4 < far < 1.6


@pytest.mark.parametrize("several", [True, False])
def test_all_moves_on_as_it_did_among_other_places(several):
    table, _ = a_table(several=several)
    g = torch.Generator().manual_seed(1)
    values, own = table.zeros(), len(table.moments)
    turned = torch.stack([0.2 * table.moments, 0.1 * table.moments.square()], 1) / len(table.levels)
    values[:own, :, 0], values[:own, :, 4] = turned[:, :1], turned[:, 1:]
    values[own:, :, 2] = 0.05
    table.sharpen(values, 0.7)
    found = 0.5 + 0.3 * torch.rand(400, 3, generator=g)  # the object was smaller than thought
    other, moved = table.among(values, found, g)
    assert [len(x) for x in other.levels] == [n for n in (1, 12, 48, 192, 600)[: 4 + several] if n <= 400]
    assert all(any((place == found).all(1)) for places in other.levels for place in places)
    for t in (-1.0, -0.3, 0.5):
        before, turn = table.pose(values, table.weights(found), found, t)
        after, turn_after = other.pose(moved, other.weights(found), found, t)
        assert (after - before).abs().max() < 0.01 and (turn_after - turn).abs().max() < 0.01
