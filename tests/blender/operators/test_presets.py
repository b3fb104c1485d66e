# SPDX-License-Identifier: GPL-3.0-or-later
"""Presets: what they set, that each is more work than the one before, and what the worker and the capture are asked."""

from dataclasses import astuple

from timesplat.model.fitting.fit_tracks import FIT
from timesplat.model.fitting.quality import QUALITIES
from timesplat.model.fitting.refine import FROM_DEPTH
from timesplat.model.methods import METHODS

PRESETS = """
part("addon").register()
presets, estimates, settings = part("addon.operators.presets"), part("addon.estimates"), part("addon.settings")
reconstruct = part("addon.operators.reconstruct")
chosen = bpy.context.scene.timesplat
default, told, followed = [chosen.method, settings.fit(chosen), presets.active(chosen)], {}, {}
for key, *_ in presets.PRESET_ITEMS:
    chosen.method, chosen.budget = "deform", "NUMBER"
    bpy.ops.timesplat.preset(preset=key)
    e = estimates.estimate(chosen, bpy.context)
    assert presets.active(chosen) == key
    same = [getattr(chosen, k) == v for k, v in presets.PRESETS[key].items()]
    told[key] = [all(same), chosen.method, chosen.budget, settings.fit(chosen), chosen.size, e.reconstructing,
                 e.gaussians]
for method, *_ in settings.METHODS:
    chosen.method = method
    shot = reconstruct.request(chosen, bpy.context)
    followed[method] = [shot["tracks"], shot["passes"]]
chosen.property_unset("quality")
chosen.refine = 10.0  # a script that names seconds alone means them
tell(default=default, presets=told, followed=followed, seconds=settings.fit(chosen), qualities=estimates.QUALITIES,
     most=estimates.MOST_STEPS, tracks=estimates.TRACK_STEPS)
"""


def test_the_presets(blender):
    told = blender(PRESETS)
    assert [n.lower() for n in told["presets"]] == list(QUALITIES)
    assert told["default"] == ["tracks", {"quality": "balanced", "refine": 0.0}, "BALANCED"]
    assert told["seconds"] == {"quality": None, "refine": 10.0}
    work = [(size, seconds, gaussians) for *_, size, seconds, gaussians in told["presets"].values()]
    assert work == sorted(work)
    for (name, quality), (*same, fit, size, _, gaussians) in zip(
        QUALITIES.items(), told["presets"].values(), strict=True
    ):
        assert same == [True, "tracks", "ALL"] and fit == {"quality": name, "refine": 0.0}
        assert size == quality.size and gaussians <= quality.gaussians
    assert told["followed"] == {
        "tracks": [0, True], "guided": [None, True], "lift": [None, True], "deform": [None, False],
    }  # fmt: skip
    assert set(told["followed"]) <= set(METHODS)


def test_estimates_know_what_the_worker_does(blender):
    told = blender(PRESETS)
    assert {k.lower(): tuple(v) for k, v in told["qualities"].items()} == {k: astuple(q) for k, q in QUALITIES.items()}
    assert told["most"] == {"guided": FROM_DEPTH.max_steps, "lift": FROM_DEPTH.max_steps}
    assert told["tracks"] == [FIT.least_steps, FIT.steps_a_view]
