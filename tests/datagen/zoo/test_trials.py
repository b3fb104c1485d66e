# SPDX-License-Identifier: GPL-3.0-or-later
"""Trials: within sight, the same each time, and as hard as their level says."""

import numpy as np
import pytest

from timesplat.datagen.zoo.trials import BETWEEN, REACH, SMALL, STEPS, TIMES, TRIALS
from timesplat.evaluation.stress.sweeps import SWEEPS

LEVELS = [(n, x) for n in TRIALS if n in SWEEPS for x in SWEEPS[n].levels]


def middle(trial, part=0):
    """(STEPS,3) of the middle of a part."""
    return trial.parts[part].posed.mean(1)


@pytest.mark.parametrize(("name", "level"), [("calm", 0.0), *LEVELS])
def test_it_is_seen_whole_and_the_same_again(name, level):
    trial, again = TRIALS[name](level), TRIALS[name](level)
    for part, other in zip(trial.parts, again.parts, strict=True):
        assert part.posed.shape == (STEPS, len(part.rest), 3) and np.array_equal(part.posed, other.posed)
        assert np.isfinite(part.posed).all() and part.paint in trial.paints
        assert max(map(max, part.faces)) < len(part.rest)
        far = np.linalg.norm(part.posed, axis=-1).max()
        assert far < (1.85 if name == "aside" else 1.15), "no camera sees more than a ball of 1.1 whole"


@pytest.mark.parametrize("level", SWEEPS["speed"].levels)
def test_speed_is_in_radii_a_moment(level):
    way = np.linalg.norm(np.diff(middle(TRIALS["speed"](level)), axis=0), axis=1) * BETWEEN
    assert np.isclose(np.median(way), level * SMALL, atol=1e-9)
    assert np.abs(middle(TRIALS["speed"](level)) - middle(TRIALS["speed"](0))[0]).max() <= 2 * REACH


@pytest.mark.parametrize("level", SWEEPS["bend"].levels)
def test_bends_turn_at_one_speed(level):
    steps = np.diff(middle(TRIALS["bend"](level)), axis=0)
    length = np.linalg.norm(steps, axis=1)
    cosine = (steps[1:] * steps[:-1]).sum(1) / (length[1:] * length[:-1])
    assert np.allclose(np.degrees(np.arccos(np.clip(cosine, -1, 1))) * BETWEEN, level, atol=1e-3)
    # a chord is a little shorter than its arc
    assert np.all(length * BETWEEN <= 0.6 * SMALL + 1e-9) and np.all(length * BETWEEN > 0.58 * SMALL)


def test_jumps_are_counted():
    for level in SWEEPS["jumps"].levels:
        moved = np.linalg.norm(np.diff(middle(TRIALS["jumps"](level)), axis=0), axis=1) > 1e-6
        assert moved.sum() == level and not (moved[3::4]).any(), "never when a moment begins"


def test_a_spin_turns_by_its_level():
    blade = TRIALS["spin"](30.0).parts[1].posed
    a, b = (blade[i] - blade[i].mean(0) for i in (0, BETWEEN))
    turn = np.linalg.lstsq(a, b, rcond=None)[0]
    assert np.isclose(np.degrees(np.arccos((np.trace(turn) - 1) / 2)), 30, atol=1e-6)


def test_so_many_things_appear_or_vanish():
    for level in SWEEPS["appear"].levels:
        balls = [p for p in TRIALS["appear"](level).parts if p.name == "ball"]
        sizes = np.stack([np.ptp(p.posed, axis=1).max(-1) for p in balls])
        assert (np.ptp(sizes, axis=1) > 0.1).sum() == level


def test_two_things_meet_as_deep_as_said():
    for level in SWEEPS["contact"].levels:
        parts = TRIALS["contact"](level).parts
        apart = np.linalg.norm(middle(TRIALS["contact"](level)) - parts[5].posed.mean(1), axis=1)
        assert np.isclose(apart.min(), 2 * 0.3 * (1 - level), atol=1e-6)
        assert parts[5].name == "body" and TIMES[apart.argmin()] == 5.5


def test_rods_are_as_thick_as_said():
    rod = TRIALS["thin"](4.0).parts[0].rest
    axis = rod.mean(0) - rod[0]
    assert np.linalg.norm(axis) > 0.5
    ends = rod[:6] - rod[:6].mean(0)
    assert np.ptp(ends, axis=0).max() < 0.081


def test_looks_change_with_their_level():
    lost = [np.ptp(TRIALS["plain"](x).paints["skin"].colours, axis=0).max() for x in (0, 0.5, 1)]
    assert lost[0] > lost[1] > lost[2] == pytest.approx(0, abs=1e-12)
    assert TRIALS["glass"](0.75).paints["skin"].alpha == 0.25
    assert TRIALS["gloss"](1.0).paints["skin"].metallic == 1.0
    assert TRIALS["repeated"](16).paints["skin"].pattern == "checker"
