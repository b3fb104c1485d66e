# SPDX-License-Identifier: GPL-3.0-or-later
"""Presets: what the three set, and that each is more work than the one before."""

from timesplat.model.methods import METHODS

PRESETS = """
part("addon").register()
presets, estimates = part("addon.operators.presets"), part("addon.estimates")
chosen = bpy.context.scene.timesplat
default, told = chosen.method, {}
for key, *_ in presets.PRESET_ITEMS:
    chosen.method, chosen.budget = "rgb", "NUMBER"
    bpy.ops.timesplat.preset(preset=key)
    e = estimates.estimate(chosen, bpy.context)
    same = [getattr(chosen, k) == v for k, v in presets.PRESETS[key].items()]
    told[key] = [all(same), chosen.method, chosen.budget, e.rendering + e.reconstructing, e.gaussians]
tell(default=default, presets=told, methods=[m[0] for m in part("addon.settings").METHODS])
"""


def test_the_three_presets(blender):
    told = blender(PRESETS)
    assert list(told["presets"]) == ["DRAFT", "BALANCED", "FINE"] and told["default"] == "tracks"
    assert set(told["methods"]) <= set(METHODS)
    work = [(seconds, gaussians) for *_, seconds, gaussians in told["presets"].values()]
    assert work == sorted(work)
    assert all(row[:3] == [True, "tracks", "ALL"] for row in told["presets"].values())
