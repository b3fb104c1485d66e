# SPDX-License-Identifier: GPL-3.0-or-later
"""What the panel expects a reconstruction to take, corrected by what the last ones took, in later sessions too."""

import pytest

ESTIMATE = """
part("addon").register()
estimates = part("addon.estimates")
chosen = bpy.context.scene.timesplat
def expected():
    e = estimates.estimate(chosen, bpy.context)
    return [e.rendering, e.reconstructing]
"""
LEARN = """
told = {"first": expected()}
n = estimates.estimate(chosen, bpy.context).pictures
estimates.learn_speed(103.0, n * chosen.size**2, chosen.samples)
estimates.learn_pace(3 * told["first"][1], told["first"][1])
told["then"] = expected()
estimates.learn_pace(told["then"][1] / 2, told["then"][1])
told["again"] = expected()
estimates.learn_pace(1e9, 1.0)
told["asleep"] = expected()
estimates.learn_pace(told["again"][1], told["asleep"][1])
tell(**told)
part("addon").unregister()
"""


def test_the_next_estimate_is_what_the_last_job_took(blender):
    told = blender(ESTIMATE + LEARN)
    first = told["first"]
    assert told["then"] == [pytest.approx(103), pytest.approx(3 * first[1])]
    assert told["again"][1] == pytest.approx(1.5 * first[1]), "measured against what was said, not what is built in"
    assert told["asleep"][1] == pytest.approx(20 * first[1])
    later = blender(ESTIMATE + "tell(now=expected())\npart('addon').unregister()")
    assert later["now"] == [pytest.approx(103), pytest.approx(1.5 * first[1])]
    damaged = """
(part("addon.runtime.folders").user_folder("estimates") / "learnt.json").write_text('{"pace": "fast"}')
estimates._learnt.update(seconds_a_sample=2e-7, pace=1.0)
estimates.register()
tell(now=expected())
part('addon').unregister()
"""
    assert blender(ESTIMATE + damaged)["now"] == first


GLASS = """
solid = expected()
chosen.method = "deform"
pictures = expected()
chosen.method = "tracks"
material = bpy.data.materials.new("glass")
material.use_nodes = True
material.node_tree.nodes["Principled BSDF"].inputs["Transmission Weight"].default_value = 1
cube = bpy.data.objects["Cube"]
cube.data.materials.clear()
cube.data.materials.append(material)
tell(solid=solid, pictures=pictures, glass=expected())
part("addon").unregister()
"""


def test_it_is_of_the_method_that_is_used(blender):
    told = blender(ESTIMATE + GLASS)
    assert told["glass"] == told["pictures"] != told["solid"]
