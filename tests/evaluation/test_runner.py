# SPDX-License-Identifier: GPL-3.0-or-later
"""Many runs: they go on where they were, and are the same in several processes."""

import pytest

from timesplat.evaluation import runner
from timesplat.evaluation.cache import Cache, find_sequences
from timesplat.evaluation.evaluate import plan
from timesplat.evaluation.method_spec import parse_specs
from timesplat.evaluation.provenance import Provenance
from timesplat.evaluation.runner import Conditions, key_of, run_all
from timesplat.evaluation.tables import gather

SETUPS, SIZES = ["", "alternating"], {16: 8, 32: 4}


@pytest.fixture
def runs(alternating_folders):
    """runs(methods, setups, sizes) on both objects."""
    sequences, _ = find_sequences([str(alternating_folders)])
    return lambda methods, setups=("",), sizes=None: plan(sequences, parse_specs(methods), setups, sizes or {32: 1})


def test_many_runs_go_on_where_they_were(runs, tmp_path, monkeypatch):
    wanted, cache = runs("white,lift", SETUPS, SIZES), Cache(tmp_path / "out")
    first = run_all(wanted, cache, Conditions())
    assert len(first) == len(wanted) == 2 * 2 * 2 * 2
    assert [(r["setup"], r["object"], r["size"], r["method"]) for r in first] == [
        (x.labels["setup"], x.object, x.size, x.method.label) for x in wanted
    ]
    lines = cache.path.read_text().splitlines()
    assert len(lines) == len(wanted) / 2  # both setups have the same views here, and so the same rows
    cache.path.write_text("\n".join(lines[:-1]) + "\n" + lines[-1][:50])
    made, plain = [], runner.evaluate_views
    monkeypatch.setattr(runner, "evaluate_views", lambda *a: made.append(a[1].label) or plain(*a))
    second = run_all(wanted, cache, Conditions())
    assert len(made) == 1 and [r["psnr"] for r in first] == [r["psnr"] for r in second]
    assert run_all(runs("hull"), cache, Conditions(deadline=0)) == []


def test_processes_give_the_same(runs, tmp_path):
    one = run_all(runs("lift"), Cache(tmp_path / "one"), Conditions())
    two = run_all(runs("lift"), Cache(tmp_path / "two"), Conditions(jobs=2))
    assert [r["object"] for r in two] == ["a", "b"] and {r["jobs"] for r in two} == {2}
    for a, b in zip(one, two, strict=True):
        assert a["psnr"] == pytest.approx(b["psnr"], abs=1e-4)


def test_a_key_is_of_all_that_has_a_say(runs):
    keys = [
        key_of(r, c)
        for r in runs("lift,lift+budget:10%,x=lift", SETUPS, SIZES)
        for c in (Conditions(), Conditions(device="cuda"), Conditions(costs=True), Conditions(left_out=("lpips",)))
    ]
    # The name of a method is none of it; the two setups have the same views here.
    assert len(set(keys)) == len(keys) / 2 / 3 * 2


def test_rows_say_which_code_made_them_and_scenes_are_kept_where_asked_for(runs, tmp_path):
    (a, _), cache = runs("lift"), Cache(tmp_path)
    conditions = Conditions(scenes=True)
    (row,) = run_all([a], cache, conditions)
    assert row["revision"] == Provenance.of("").revision and row["has_depth"]
    assert len(cache.scene(key_of(a, conditions))) == row["gaussians_kept"]
    assert gather([row], Provenance("x"))["sees"] == {"lift": "depth + motion"}
