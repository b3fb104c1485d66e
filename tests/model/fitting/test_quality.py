# SPDX-License-Identifier: GPL-3.0-or-later
"""Qualities: each is more than the one before, and what methods of every kind make of one."""

from dataclasses import astuple, replace

import pytest
import torch

from tests.model import track_scenes as scenes
from timesplat.datagen.sequence import InputError
from timesplat.model import baselines  # noqa: F401, adds its methods
from timesplat.model.fitting import loop
from timesplat.model.fitting.fit_views import squared_error
from timesplat.model.fitting.quality import QUALITIES, Quality, quality_named
from timesplat.model.methods import ReconstructOptions
from timesplat.model.reconstruct import reconstruct_views
from timesplat.model.views import shrink


def test_each_is_more_than_the_one_before():
    rows = [astuple(q) for q in QUALITIES.values()]
    assert [sorted(column) for column in zip(*rows, strict=True)] == [list(c) for c in zip(*rows, strict=True)]
    assert quality_named("draft") is QUALITIES["draft"]
    with pytest.raises(InputError, match="superb: no such quality"):
        quality_named("superb")


@pytest.fixture
def drawn(monkeypatch):
    """The sizes of the pictures that fits draw, in order. A quality of 20 steps is to be had."""
    found = []
    loop.warm_up("cpu")
    draw = loop.draw
    monkeypatch.setattr(loop, "draw", lambda scene, views, *a: found.append(views.size[0]) or draw(scene, views, *a))
    monkeypatch.setitem(QUALITIES, "tiny", Quality(24, 20, 150))
    return found


@pytest.fixture
def no_clock(monkeypatch):
    """Whoever looks at a clock stops."""
    for module in ("loop", "refine"):
        monkeypatch.setattr(f"timesplat.model.fitting.{module}.work_clock", lambda: 0.0)


@pytest.mark.parametrize("method", ["tracks", "4dgs"])
def test_what_fits_takes_its_steps_of_its_size(drawn, no_clock, method):
    g = reconstruct_views(scenes.views(), method, ReconstructOptions(quality="tiny"))
    assert len(drawn) == 20 and set(drawn) == {24} and 20 < len(g) <= 150
    assert len(reconstruct_views(scenes.views(), method, ReconstructOptions(steps=7))) > 200 and drawn[20:] == [48] * 7


@pytest.mark.parametrize("method", ["lift", "hull"])
def test_what_does_not_fit_is_refined(spheres, drawn, no_clock, method):
    views = spheres(list(range(8)), size=48)
    g = reconstruct_views(views, method, ReconstructOptions(quality="tiny"))
    assert len(drawn) == 20 and set(drawn) == {24} and 20 < len(g) <= 150
    kept = reconstruct_views(views, method, ReconstructOptions(steps=9))
    assert len(drawn) == 29 and drawn[20:] == [48] * 9 and len(kept) > 150


@pytest.mark.parametrize(("method", "share"), [("tracks", 0.8), ("4dgs", 0.95)])
def test_what_small_pictures_fitted_is_as_wide_in_large_ones(drawn, method, share):
    """Drawn in the pictures as they were given it is as good as in those that were fitted, but for what these lack."""
    views, others = scenes.views(), scenes.views(9, seed=5)
    QUALITIES["tiny"] = Quality(16, 200, 600)
    small = replace(shrink(others, 3), depth=None)
    wide = reconstruct_views(views, method, ReconstructOptions(quality="tiny"))
    plain = reconstruct_views(shrink(views, 3), method, ReconstructOptions(quality="tiny"))
    blur = 0.1 * 8 * views.pixel**2
    torch.testing.assert_close(wide.scale.square(), plain.scale.square() + blur)
    with torch.inference_mode():
        assert squared_error(wide, others) < share * squared_error(plain, others)
        assert squared_error(plain, small) < squared_error(plain, others)


def test_budgets_hold_within_a_quality(spheres, drawn, no_clock):
    views = spheres(list(range(8)), size=48)
    assert len(reconstruct_views(views, "lift", ReconstructOptions(quality="tiny", budget="60"))) <= 60
    assert len(drawn) == 20
    assert len(reconstruct_views(scenes.views(), "tracks", ReconstructOptions(quality="tiny", budget="60"))) <= 60


def test_no_method_takes_more_steps_than_it_gains_by(spheres, drawn, no_clock, monkeypatch):
    from timesplat.model.fitting import refine, track_views

    monkeypatch.setitem(QUALITIES, "long", Quality(16, 10_000, 50))
    monkeypatch.setattr(track_views, "FIT", track_views.FIT.__class__(steps_a_view=1, least_steps=25))
    reconstruct_views(scenes.views(), "tracks", ReconstructOptions(quality="long"))
    assert len(drawn) == 25
    few = refine.FROM_DEPTH.__class__(**vars(refine.FROM_DEPTH) | {"max_steps": 30})
    monkeypatch.setattr(refine, "FROM_DEPTH", few)
    reconstruct_views(spheres(list(range(8)), size=48), "lift", ReconstructOptions(quality="long"))
    assert len(drawn) == 55


def fields(scene) -> dict[str, torch.Tensor]:
    return {k: x for k, x in vars(scene).items() if isinstance(x, torch.Tensor)}


@pytest.mark.parametrize(
    ("method", "threads"), [(m, 1) for m in ("tracks", "4dgs", "som", "lift", "hull")] + [("tracks", 2), ("lift", 2)]
)
def test_the_same_steps_give_the_same_bits(spheres, method, threads):
    """On one machine, whatever else it does, for a number of threads; another seed gives others. Long enough for
    densification, and for refinement to merge."""
    views = scenes.views() if method == "tracks" else spheres(list(range(8)), size=32)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        a, b, other = (reconstruct_views(views, method, ReconstructOptions(steps=90, seed=seed)) for seed in (0, 0, 1))
    finally:
        torch.set_num_threads(before)
    a, b, other = (fields(getattr(x, "gaussians", x)) for x in (a, b, other))
    assert a and all(torch.equal(x, b[k]) for k, x in a.items())
    assert any(x.shape != other[k].shape or not torch.equal(x, other[k]) for k, x in a.items())
