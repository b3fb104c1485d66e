# SPDX-License-Identifier: GPL-3.0-or-later
"""Plans of steps for seconds, on machines made of arithmetic: none of these tests times anything."""

from itertools import pairwise

import pytest

from timesplat.model.fitting.plan import Costs, Plan, TimedPlan


def gone_through(plan: Plan, cost, start: float = 0.0) -> tuple[int, float, list[float], list[str]]:
    """Steps and seconds that a fit takes whose steps cost `cost(elapsed, fraction)` seconds, the shares of the schedule
    that it was at, and what was said."""
    elapsed, done, shares, said = start, 0, [], []
    while True:
        said += [s] if (s := plan.look(elapsed, done)) else []
        shares.append(plan.fraction(done))
        if shares[-1] >= 1:
            return done, elapsed, shares, said
        elapsed += cost(elapsed, shares[-1])
        done += 1


def even(seconds: float) -> Costs:
    return Costs(((1.0, seconds),))


def largest_change(shares: list[float]) -> float:
    """Of the share that a step is, from one step to the next, as a factor; the last step may be short."""
    each = [b - a for a, b in pairwise(shares[:-1])]
    return max(max(b / a, a / b) for a, b in pairwise(each))


def test_steps_are_even():
    plan = Plan(4)
    assert [plan.fraction(n) for n in range(6)] == [0, 0.25, 0.5, 0.75, 1, 1] and Plan(0).fraction(0) == 1
    plan.leave(6, 2)
    assert plan.steps == 8 and plan.fraction(2) == 0.5 and plan.fraction(5) == 0.75 and plan.fraction(8) == 1
    assert plan.look(1e9, 3) == ""


@pytest.mark.parametrize("each", [0.001, 0.01, 0.1, 3.0])
def test_a_slow_machine_plans_fewer_steps(each):
    plan = TimedPlan(10, even(each))
    assert plan.steps == max(round(10 / each), 1)
    done, elapsed, shares, said = gone_through(plan, lambda *_: each)
    assert done == plan.steps and said == [] and elapsed == pytest.approx(10, abs=each) and shares == sorted(shares)


def test_small_pictures_count_for_what_they_cost_and_measuring_too():
    plan = TimedPlan(10, Costs(((0.6, 0.01), (1.0, 0.04))), elapsed=0.5)
    assert plan.steps == round(9.5 / (0.6 * 0.01 + 0.4 * 0.04))
    done, elapsed, _, _ = gone_through(plan, lambda _, f: 0.01 if f < 0.6 else 0.04, 0.5)
    assert elapsed == pytest.approx(10, rel=0.02) and done == plan.steps
    assert TimedPlan(10, even(0.01), most=300).steps == 300
    assert gone_through(TimedPlan(10, even(0.01), most=300), lambda *_: 0.001)[0] == 300


@pytest.mark.parametrize("factor", [0.4, 0.6, 1.7, 3.0])
def test_a_wrong_measure_is_corrected_early_and_without_a_jump(factor):
    plan = TimedPlan(10, even(0.01))
    _, elapsed, shares, said = gone_through(plan, lambda *_: 0.01 * factor)
    assert elapsed == pytest.approx(10, rel=0.1) and shares == sorted(shares) and not said
    assert largest_change(shares) < 2.01


def test_a_scene_that_grows_ends_in_time():
    plan = TimedPlan(10, even(0.01))
    _, elapsed, _, said = gone_through(plan, lambda _, f: 0.01 * (1 + min(f, 0.6)))
    assert elapsed == pytest.approx(10, rel=0.1) and not said


@pytest.mark.parametrize("slower", [1.5, 1.9])
def test_a_machine_that_becomes_busy_finishes_the_schedule(slower):
    quiet = gone_through(TimedPlan(10, even(0.01)), lambda *_: 0.01)
    done, elapsed, shares, said = gone_through(
        TimedPlan(10, even(0.01)), lambda t, _: 0.01 * (slower if t > 5.1 else 1)
    )
    assert 0.9 * quiet[0] < done <= quiet[0] and shares[-1] == 1 and largest_change(shares) < 1.26
    assert not said and 10 < elapsed <= 15


@pytest.mark.parametrize("slower", [4, 30, 300])
def test_what_would_take_too_long_is_cut_short_and_said_once(slower):
    plan = TimedPlan(10, even(0.01))
    done, elapsed, shares, said = gone_through(plan, lambda t, _: 0.01 * (slower if t > 6 else 1))
    assert shares[-1] == 1 and shares == sorted(shares) and done < 1000
    assert elapsed < 16 + 2 * 0.01 * slower
    assert len(said) == 1 and said[0].startswith("slower than planned: the last ")


def test_a_moments_stall_costs_no_more_than_half_of_the_rest():
    stalls = iter([4.0])
    plan = TimedPlan(10, even(0.01))
    done, _, _, said = gone_through(plan, lambda t, _: next(stalls, 0.01) if t > 0.5 else 0.01)
    assert done > 450 and not said
