# SPDX-License-Identifier: GPL-3.0-or-later
"""The registry of methods: what each needs, and that the product knows no baseline."""

import subprocess
import sys

import pytest

from timesplat.datagen.sequence import InputError
from timesplat.model import baselines  # noqa: F401, adds its methods
from timesplat.model.methods import METHODS, Method, ReconstructOptions, method_named, register


def named(**wanted) -> set[str]:
    return {m.name for m in METHODS.values() if all(getattr(m, k) == v for k, v in wanted.items())}


def test_what_methods_are():
    assert all(name == m.name and m.about for name, m in METHODS.items())
    assert named(has_depth=True) == {"tracks", "flow", "lift", "guided"}
    assert named(knows_surface=True) == {"lift", "guided", "rgb", "sweep"}
    assert named(fits=True) == {"tracks", "flow", "deform", "4dgs", "som"}
    assert named(baseline=False) == {"lift", "guided", "rgb", "sweep", "deform", "tracks", "flow"}
    assert named(checkpoint="static") == {"gs-lrm-frame", "gs-lrm-all"}
    assert named(checkpoint="sweep") == {"rgb", "sweep"}
    assert all(m.about.startswith("ours") != m.baseline for m in METHODS.values())


def test_a_method_is_found_by_its_name(monkeypatch):
    monkeypatch.setattr("timesplat.model.methods.METHODS", dict(METHODS))
    register(Method("mine", "a test's", lambda views, options, progress: views))
    assert method_named("mine").run(3, None, None) == 3
    with pytest.raises(
        InputError, match=r"^magic: no such method; choose one of tracks, flow, lift, guided, .*mine\.$"
    ):
        method_named("magic")


def test_without_baselines_there_are_the_products_methods():
    """As in the extension, which does not hold them."""
    code = "import timesplat.model.reconstruct as r, sys; from timesplat.model.methods import METHODS; print(*METHODS)"
    code += "; print([m for m in sys.modules if 'baselines' in m])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.splitlines() == ["tracks flow lift guided rgb sweep deform predicted", "[]"]


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"refine": -1.0}, "-1 seconds of refinement: give 0 or more"),
        ({"refine": float("nan")}, "seconds of refinement"),
        ({"budget": "some"}, "some: no budget"),
        ({"quality": "superb"}, "superb: no such quality; choose one of draft, balanced, fine, best"),
        ({"steps": 0}, "0 steps: give 1 or more"),
        ({"quality": "draft", "steps": 3}, "quality and steps: .* give one of them"),
        ({"steps": 3, "refine": 3.0}, "steps and refine: .* give one of them"),
        ({"quality": "draft", "refine": 3.0}, "quality and refine: .* give one of them"),
    ],
)
def test_impossible_options_are_refused(options, word):
    with pytest.raises(InputError, match=word):
        ReconstructOptions(**options)
