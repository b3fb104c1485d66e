# SPDX-License-Identifier: GPL-3.0-or-later
"""The registry of sweeps."""

import pytest

from timesplat.datagen.sequence import InputError
from timesplat.datagen.zoo.trials import TRIALS
from timesplat.evaluation.stress.sweeps import SWEEPS, Condition, sweeps_named


def test_what_is_rendered_is_a_trial():
    rendered = {s.name for s in SWEEPS.values() if s.disturb is None} - {"size", "seed", "threads"}
    assert rendered == TRIALS.keys() - {"calm"}


def test_levels():
    for sweep in SWEEPS.values():
        assert len(sweep.levels) > 1 and len(set(sweep.levels)) == len(sweep.levels)
        assert not sweep.quick or len(sweep.quick) > 1
        assert not set(sweep.quick) - set(sweep.levels) or sweep.name in ("thin", "few")
        assert list(sweep.levels) in (sorted(sweep.levels), sorted(sweep.levels, reverse=True))


def test_undisturbed_inputs_are_measured_once():
    first = {s.conditions(False, 96)[0] for s in SWEEPS.values() if s.disturb and not s.all_views}
    assert first == {Condition()}
    keys = {c.key for s in SWEEPS.values() for c in s.conditions(False, 96).values()}
    conditions = {c for s in SWEEPS.values() for c in s.conditions(False, 96).values()}
    assert len(keys) == len(conditions)
    folders = [c.folder for c in conditions if not c.seed and c.threads == 1]
    assert len(set(folders)) == len(folders)


def test_names():
    assert [s.name for s in sweeps_named("spin, speed,spin", False)] == ["spin", "speed"]
    assert all(s.quick for s in sweeps_named(None, True)) and len(sweeps_named(None, False)) == len(SWEEPS)
    for text, quick, said in (
        ("spn", False, "no such sweep"),
        ("jumps", True, "drop --quick"),
        (",", False, "at least"),
    ):
        with pytest.raises(InputError, match=said):
            sweeps_named(text, quick)
